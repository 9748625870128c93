"""Three dates: what stands in each world, and the exact reason of each change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereocities.cities import CitySpec, Dates
from stereocities.render import prepare
from stereocities.surfaces import IN_IMAGES, IN_LEFT, IN_LIDAR, IN_RIGHT, terrain_heights
from stereocities.truth import REASONS, changes_at, truth_at
from stereocities.world import surfaces_of, world_of

from ...synthetic.small_cities import TOWN, TREE

OLD_LIDAR = Dates(900.0, 900.0, 0.0)
THREE = Dates(600.0, 900.0, 0.0)


def seen(city: CitySpec, view: str = "left") -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    camera = getattr(prepare(city, city.scenes[0]), view)
    col, row = np.meshgrid(np.arange(20.0, camera.cols - 20, 2), np.arange(20, camera.rows - 20, 2))
    scene = city.scenes[0]
    return changes_at(city, scene, col, row, view), truth_at(city, scene, col, row, view)


def dated(dates: Dates, **shares: float) -> CitySpec:
    return replace(TOWN, name="Dated", dates=replace(dates, **shares))


def test_without_shares_three_dates_are_one_world() -> None:
    changes, truth = seen(dated(THREE))
    assert not changes["reason"].any()
    assert not truth["changed"].any() and not truth["changed_right"].any()
    assert (changes["height"] == changes["height_lidar"]).all()


@pytest.mark.parametrize(
    "what, reason, higher",
    [
        ("built", "built", True),
        ("raised", "built", True),
        ("demolished", "demolished", False),
        ("felled", "grown_or_felled", False),
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


def test_things_change_at_moments_of_their_own() -> None:
    """Between LiDAR and left image, or between the images: two thirds and one third of the time."""
    city = dated(THREE, built=1.0)
    view = surfaces_of(city).box_view
    left = (view & (IN_IMAGES | IN_LEFT)) > 0
    right = (view & (IN_IMAGES | IN_RIGHT)) > 0
    assert not (view & IN_LIDAR).any() and right.all()
    assert 0.5 < left.mean() < 0.8
    _, truth = seen(city, "right")
    alone = truth["surface"] > 0
    assert (truth["visible_right"][alone] == 0).mean() > 0.1


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
    renewed = dated(THREE, resurfaced=0.5)
    changes, truth = seen(renewed)
    texture = changes["reason"] == REASONS.split().index("texture")
    assert 0.005 < texture.mean() < 0.2
    assert set(np.unique(changes["reason"])) == {0, REASONS.split().index("texture")}
    assert not truth["changed"].any()
