"""Twins of real places: what is made of points of a house whose surface is known."""

from __future__ import annotations

import json
from dataclasses import replace

import laspy
import numpy as np
import pyproj
import pytest

from stereocities.camera import rays
from stereocities.cities import Dates, FlightStrip, Jitter, ViewSpec, read_city, write_city
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import prepare
from stereocities.surfaces import (
    GROUND,
    PATCH_M,
    PATCHES_A_CELL,
    ROOF,
    TREE,
    WALL,
    terrain_heights,
)
from stereocities.truth import BUILT, DEMOLISHED, changes_at, truth_at
from stereocities.twin_world import twin_city
from stereocities.world import top_surface
from stereotruth.core.errors import InputError

from ...synthetic import house_points as place


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    return twin_city("House", place.write_place(tmp_path_factory.mktemp("twin") / "house.laz"))


def geodetic(x, y):
    to = pyproj.Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True)
    return to.transform(place.ORIGIN[0] + x, place.ORIGIN[1] + y)


def test_ground_and_roofs_are_those_of_the_house(house):
    """At a metre from walls: the height of the planes, to a tenth of the points' spacing."""
    x, y = np.meshgrid(np.arange(-58.0, 59.0, 1.3), np.arange(-58.0, 59.0, 1.3))
    around = np.stack([place.top_of(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)])
    true = around[4]
    clear = np.ptp(around, axis=0) < 0.5
    for middle, radius, _ in place.TREES:
        clear &= np.hypot(x - middle[0], y - middle[1]) > radius + 2.5
    height, kind = top_surface(house, *geodetic(x, y))
    error = (height - true)[clear]
    assert np.abs(error).max() < 0.08 and abs(error.mean()) < 0.01
    assert (kind[clear] == np.where(true[clear] > place.GROUND_Z, ROOF, GROUND)).all()
    for middle, _, top in place.TREES:
        height, kind = top_surface(house, *geodetic(*(np.array([v]) for v in middle)))
        assert kind[0] == TREE and top - 2.0 < height[0] < top + 0.3


def test_walls_stand_where_the_house_ends(house):
    """The eaves in plan, along both axes, to less than the spacing of the points."""
    step = 0.05
    for along, across, half in ((0, 1, place.HOUSE[1]), (1, 0, place.HOUSE[0])):
        out = np.arange(half - 3, half + 3, step)
        places = np.linspace(-0.7, 0.7, 9) * place.HOUSE[along]
        at = [None, None]
        for sign in (-1, 1):
            at[along], at[across] = np.broadcast_arrays(places[:, None], sign * out)
            high = top_surface(house, *geodetic(*at))[0] > place.GROUND_Z + 4
            edge = out[0] + step * high.sum(axis=1)
            assert np.abs(edge - half).max() < 0.6 and abs(edge.mean() - half) < 0.25


def solid_height(s, x, y):
    """Height of ground and patches at plan positions, by looking them up."""
    m = np.floor((x - s.x0) / PATCH_M).astype(int) - PATCHES_A_CELL * s.patch_i
    n = np.floor((y - s.y0) / PATCH_M).astype(int) - PATCHES_A_CELL * s.patch_j
    rows, cols = s.patches.shape[:2]
    inside = (m >= 0) & (n >= 0) & (m < cols) & (n < rows)
    patch = s.patches[np.clip(n, 0, rows - 1), np.clip(m, 0, cols - 1)].astype(float)
    middle_x = s.x0 + PATCH_M * (m + PATCHES_A_CELL * s.patch_i + 0.5)
    middle_y = s.y0 + PATCH_M * (n + PATCHES_A_CELL * s.patch_j + 0.5)
    z = patch[..., 0] + patch[..., 1] * (x - middle_x) + patch[..., 2] * (y - middle_y)
    ground = terrain_heights(s, np.column_stack([x.ravel(), y.ravel()]))[:, 0].reshape(x.shape)
    return np.maximum(ground, np.where(inside, z, -1e9))


def test_truth_is_where_rays_first_meet_a_solid(house):
    """Followed downward in steps of 4 mm, through the right image, which looks from the side."""
    (scene,) = house.scenes
    ready = prepare(house, scene)
    rng = np.random.default_rng(2)
    near = rng.uniform(0.3, 0.7, (600, 2)) * [ready.right.cols, ready.right.rows]
    truth = truth_at(house, scene, *near.T, "right")
    leafless = np.isin(truth["surface"], (GROUND, ROOF, WALL))
    assert [(truth["surface"] == kind).sum() > 5 for kind in (GROUND, ROOF, WALL)] == [True] * 3
    origin, toward = rays(ready.right.cam, near[leafless])
    z = np.arange(20.0, -3.0, -0.004)
    x, y = (origin[:, k, None] + toward[:, k, None] * (z - origin[:, 2, None]) for k in (0, 1))
    first = np.argmax(solid_height(ready.surfaces, x, y) > z, axis=1)
    shown = ready.frame.from_geodetic(
        np.column_stack([truth[k][leafless] for k in ("lon", "lat", "height")])
    )
    assert np.abs(z[first] - shown[:, 2]).max() < 0.005
    assert (truth["changed"] == 0).all()


def test_the_lidar_of_a_twin_lies_on_it(house, tmp_path):
    """It is sampled from the surface, with noise, where the file has points."""
    (scene,) = house.scenes
    file = tmp_path / f"{scene.name}_0_0.laz"
    simulate_lidar_tile(house, scene, file.name, file, spacing_m=0.7, seed=1)
    cloud = laspy.read(file)
    x, y = cloud.x - place.ORIGIN[0], cloud.y - place.ORIGIN[1]
    assert np.abs([x, y]).max() < place.HALF_M + 0.2
    assert cloud.header.point_count == pytest.approx((2 * place.HALF_M / 0.7) ** 2, rel=0.1)
    open_ground = (cloud.classification == 2) & (place.top_of(x, y) == place.GROUND_Z)
    off = (cloud.z - place.GROUND_Z)[open_ground]
    assert off.std() == pytest.approx(0.03, abs=0.015) and abs(off.mean()) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("share", "days", "reason", "changed"),
    [
        ("raised", (9.0, 9.0, 0.0), BUILT, 2),
        ("demolished", (0.0, 9.0, 0.0), DEMOLISHED, 0),
    ],
)
def test_buildings_of_a_twin_have_their_dates(house, share, days, reason, changed):
    """All of them change between LiDAR and images, or between the images."""
    city = replace(house, dates=Dates(*days, **{share: 1.0}))
    (scene,) = city.scenes
    row, col = np.mgrid[20 : scene.rows - 20 : 5, 20 : scene.cols - 20 : 5].astype(float)
    found, truth = changes_at(city, scene, col, row), truth_at(city, scene, col, row)
    off = np.fmax(*(np.abs(found["height"] - found[f"height_{of}"]) for of in ("lidar", "other")))
    differs = off > 3.0
    assert differs.sum() > 100 and set(found["reason"][differs]) == {reason}
    assert set(truth["changed"][differs]) == {changed}
    untouched = off < 0.01
    assert (truth["changed"][untouched] == 0).all()
    if days[0] != days[1]:  # what is gone in the right image is neither seen there nor hidden
        roofs = differs & (truth["surface"] == ROOF)
        assert roofs.sum() > 50
        assert not (truth["visible_right"] | truth["hidden_right"])[roofs].any()


def test_files_that_no_twin_can_be_made_of_are_refused(tmp_path):
    file = place.write_place(tmp_path / "none.laz", crs=False)
    given = twin_city("None", file, crs="EPSG:32631")
    assert given.twin.half_m == pytest.approx((place.HALF_M, place.HALF_M), abs=0.5)
    (tmp_path / "no.laz").write_text("no points")
    for name, more in {
        "none.laz": ({}, {"crs": "EPSG:1"}, {"crs": "EPSG:4326"}),
        "no.laz": ({},),
        "away.laz": ({},),
    }.items():
        for settings in (*more, {"crs": "EPSG:32631", "size_px": (4000, 300)}):
            with pytest.raises(InputError, match=rf"{name}.*Remedy"):
                twin_city("None", tmp_path / name, **settings)


def test_a_city_comes_back_from_its_file(house, tmp_path):
    write_city(house, tmp_path / "city.json")
    assert read_city(tmp_path / "city.json") == house
    edited = json.loads((tmp_path / "city.json").read_text()) | {
        "right": {"sun_deg": [190, 40], "jitter": {"rms_px": 0.18}, "saturates": 0.6},
        "strips": [{"offset_m": [0.2, 0, 0.06]}, {"offset_m": [-0.2, 0.1, -0.06]}],
        "dates": {"left": 9, "right": 9, "lidar": 0, "felled": 0.2},
    }
    (tmp_path / "city.json").write_text(json.dumps(edited))
    assert read_city(tmp_path / "city.json") == replace(
        house,
        right=ViewSpec((190.0, 40.0), jitter=Jitter(0.18), saturates=0.6),
        strips=(FlightStrip((0.2, 0.0, 0.06)), FlightStrip((-0.2, 0.1, -0.06))),
        dates=Dates(9.0, 9.0, 0.0, felled=0.2),
    )
    (tmp_path / "city.json").write_text('{"name": "A"}')
    with pytest.raises(InputError, match="lon"):
        read_city(tmp_path / "city.json")
