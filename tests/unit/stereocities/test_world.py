"""A built city: its top surface, its file, and what stands in it at each date."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereocities.cities import CitySpec, Dates, lidar_files
from stereocities.layout import frame_of
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import prepare, simulate_image
from stereocities.surfaces import terrain_heights
from stereocities.truth import REASONS, changes_at, truth_at
from stereocities.world import (
    build_surfaces,
    surfaces_of,
    top_surface,
    world_of,
    write_surfaces,
)

from ...synthetic.small_cities import GROUND, ONE_BOX, ROOF, TOWN, TREE

OLD_LIDAR = Dates(900.0, 900.0, 0.0)
THREE = Dates(600.0, 900.0, 0.0)


def test_a_single_box_is_as_high_and_wide_as_it_is():
    x, y, length, width, height = ONE_BOX.single_box
    places = np.array([
        [x, y, 0.0], [x + length / 2 - 0.01, y + width / 2 - 0.01, 0.0],
        [x + length / 2 + 0.02, y, 0.0],
    ])  # fmt: skip
    places[:, 2] = height  # the plan position is that of the roof's height
    lon, lat, _ = frame_of(ONE_BOX).to_geodetic(places).T
    found, kind = top_surface(ONE_BOX, lon, lat)
    assert kind.tolist() == [ROOF, ROOF, GROUND]
    assert found[0] - found[2] == pytest.approx(height, abs=0.01)
    ground = frame_of(ONE_BOX).from_geodetic(np.array([[lon[2], lat[2], found[2]]]))
    expected = terrain_heights(build_surfaces(ONE_BOX), ground[:, :2])[0, 0]
    assert ground[0, 2] == pytest.approx(expected, abs=1e-3)
    outside, kind = top_surface(ONE_BOX, lon[:1] + 1, lat[:1])
    assert np.isnan(outside[0]) and kind[0] == 0


def seen(city: CitySpec, view: str = "left") -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    camera = getattr(prepare(city, city.scenes[0]), view)
    col, row = np.meshgrid(np.arange(20.0, camera.cols - 20, 2), np.arange(20, camera.rows - 20, 2))
    scene = city.scenes[0]
    return changes_at(city, scene, col, row, view), truth_at(city, scene, col, row, view)


def dated(dates: Dates, **shares: float) -> CitySpec:
    return replace(TOWN, name="Dated", dates=replace(dates, **shares))


@pytest.mark.parametrize(
    "what, reason, higher",
    [
        ("raised", "built", True),
        ("demolished", "demolished", False),
        ("grown", "grown_or_felled", True),
    ],
)
def test_the_reason_is_what_changed(what: str, reason: str, higher: bool) -> None:
    """All that differs between LiDAR and images is of the kind that was asked for, and its sign."""
    changes, truth = seen(dated(OLD_LIDAR, **{what: 0.3}))
    found = changes["reason"]
    assert {REASONS.split()[k] for k in np.unique(found[found > 0])} == {reason}
    rise = (changes["height"] - changes["height_lidar"])[found > 0]
    assert (rise > 0 if higher else rise < 0).all()
    assert (np.abs(rise) > 1.0).mean() > 0.5
    assert (changes["height"] == changes["height_other"]).all()
    assert ((truth["changed"] > 0) == (found > 0)).mean() > 0.999
    if what == "grown":
        assert (truth["surface"][found > 0] == TREE).all()


def test_ground_water_and_texture_are_those_of_the_date() -> None:
    fields = replace(TOWN.character, zones={"fields": 1}, relief_m=5.0, river_m=0.0)
    crops = replace(dated(THREE, crops=1.0), character=fields)
    base = surfaces_of(crops)
    xy = np.random.default_rng(0).uniform(-150, 150, (4000, 2))
    heights = [terrain_heights(world_of(crops, base, w), xy)[:, 0] for w in ("lidar", "right")]
    rise = heights[1] - heights[0]
    assert rise.max() > 1.0 and rise.min() < -1.0 and np.abs(rise).max() < 3.01
    flood = dated(OLD_LIDAR, water_m=1.5)
    changes, truth = seen(flood)
    rise = changes["height"] - changes["height_lidar"]
    assert set(np.unique(changes["reason"])) == {0, REASONS.split().index("water")}
    assert rise.max() == pytest.approx(1.5, abs=0.01) and rise.min() > -1e-9
    changes, truth = seen(dated(THREE, resurfaced=0.5))
    texture = changes["reason"] == REASONS.split().index("texture")
    assert 0.005 < texture.mean() < 0.2
    assert set(np.unique(changes["reason"])) == {0, REASONS.split().index("texture")}
    assert not truth["changed"].any()


def test_a_city_of_the_same_spec_from_a_file_gives_the_same_files(town: Path, tmp_path: Path):
    scene, name = TOWN.scenes[0], lidar_files(TOWN, TOWN.scenes[0])[1]
    surfaces_of.__globals__["_surfaces_of"].cache_clear()
    write_surfaces(TOWN, tmp_path / "built.npz")
    built = {"seed": 1, "built": tmp_path / "built.npz"}
    simulate_image(TOWN, scene, "left", tmp_path / "left.tif", **built)
    simulate_lidar_tile(TOWN, scene, name, tmp_path / name, **built)
    assert (tmp_path / "left.tif").read_bytes() == (town / "left.tif").read_bytes()
    assert (tmp_path / name).read_bytes() == (town / "lidar" / name).read_bytes()
