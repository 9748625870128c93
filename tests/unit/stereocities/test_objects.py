"""Buildings, vehicles and crowns of a city, against what its spec and geometry ask."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from stereocities.appearance import VEHICLE
from stereocities.camera import rays
from stereocities.cities import CitySpec, lidar_files
from stereocities.lidar import INSIDE, simulate_lidar_tile
from stereocities.objects import BOUGHS
from stereocities.render import prepare
from stereocities.surfaces import IN_IMAGES, IN_LEFT, IN_LIDAR, IN_RIGHT
from stereocities.world import build_surfaces

from ...synthetic.small_cities import GROUND, TOWN, TREE
from ...synthetic.wooded_cities import BARE_RIGHT, CANOPY, OPEN, WOODED, shown_by


def test_buildings_are_as_many_as_the_share_and_flat_where_asked() -> None:
    half = replace(TOWN, character=replace(TOWN.character, buildings=0.5, flat_roofs=True))
    few, all_of_them = build_surfaces(half), build_surfaces(TOWN)
    assert 0.35 < len(few.boxes) / len(all_of_them.boxes) < 0.65
    assert (few.boxes[:, 7] == 0).all() and (all_of_them.boxes[:, 7] > 0).any()


def test_vehicles_are_elsewhere_in_each_view() -> None:
    city = replace(TOWN, name="Busy", character=replace(TOWN.character, vehicles=40.0))
    s, none = build_surfaces(city), build_surfaces(TOWN)
    cars = s.box_style[:, 2] == VEHICLE
    np.testing.assert_array_equal(s.boxes[~cars], none.boxes)
    count = {bits: (s.box_view[cars] == bits).sum() for bits in (1, 2, 4, 8)}
    assert min(count.values()) >= 10
    # those that creep: the same body and paint in both views, some metres apart
    left, right = (s.boxes[cars & (s.box_view == bits)] for bits in (IN_LEFT, IN_RIGHT))
    phase = [s.box_style[cars & (s.box_view == bits), 3] for bits in (IN_LEFT, IN_RIGHT)]
    both, i, j = np.intersect1d(*phase, return_indices=True)
    assert len(both) >= 10
    way = right[j, :2] - left[i, :2]
    moved = np.hypot(*way.T)
    assert moved.min() >= 0.5 - 1e-9 and moved.max() <= 6.0 + 1e-9
    across = way[:, 0] * left[i, 3] - way[:, 1] * left[i, 2]
    assert np.abs(across).max() < 1e-9  # along the street
    # on a car of the left view alone the truth knows no counterpart
    scene = city.scenes[0]
    shown = shown_by(city, "left", 1.0)
    ready = prepare(city, scene)
    xyz = ready.frame.from_geodetic(np.column_stack([shown[n] for n in ("lon", "lat", "height")]))
    on = np.zeros(len(xyz), bool)
    for x, y, ux, uy, a, b, top, _ in left:
        dx, dy = xyz[:, 0] - x, xyz[:, 1] - y
        on |= (
            (np.abs(dx * ux + dy * uy) < a - 0.1)
            & (np.abs(dy * ux - dx * uy) < b - 0.1)
            & (np.abs(xyz[:, 2] - top) < 0.01)
        )
    assert on.sum() > 20
    assert not shown["visible_right"][on].any() and not shown["hidden_right"][on].any()
    assert (shown["changed"][on] == 2).all()


def test_the_top_of_a_rough_crown_is_the_highest_of_its_ellipsoids_on_the_ray() -> None:
    """By a search along the ray that knows nothing of the intersections' formula."""
    shown = shown_by(OPEN, "left")
    ready = prepare(OPEN, OPEN.scenes[0])
    trees = ready.surfaces.trees
    on_crowns = np.flatnonzero(shown["surface"] == TREE)
    assert len(on_crowns) > 1000
    some = np.random.default_rng(5).choice(on_crowns, 60, replace=False)
    at = np.column_stack([shown["col"], shown["row"]])[some]
    xyz = ready.frame.from_geodetic(
        np.column_stack([shown[n][some] for n in ("lon", "lat", "height")])
    )
    origin, toward = rays(ready.left.cam, at)
    for point, start, way in zip(xyz, origin, toward):
        z = point[2] + np.arange(12.0, -0.5, -0.002)
        ray = start + (z - start[2])[:, None] * way
        near = trees[np.hypot(*(trees[:, :2] - point[:2]).T) < trees[:, 3] + 8]
        inside = np.zeros(len(z), bool)
        for x, y, middle, radius, half, _ in near:
            inside |= (
                ((ray[:, 0] - x) ** 2 + (ray[:, 1] - y) ** 2) / radius**2
                + ((z - middle) / half) ** 2
            ) <= 1.0
        assert z[np.argmax(inside)] == pytest.approx(point[2], abs=0.003)


def test_a_share_of_the_pulses_passes_crowns(tmp_path: Path) -> None:
    """What lies below the tops: a porous city against the same one with closed crowns."""
    share = []
    for porosity in (0.0, 0.35, 0.8):
        canopy = replace(CANOPY, porosity=porosity, ground_m2=60.0)
        city = replace(OPEN, character=replace(OPEN.character, canopy=canopy))
        file = lidar_files(city, city.scenes[0])[0]
        simulate_lidar_tile(city, city.scenes[0], file, tmp_path / file, spacing_m=0.8, seed=3)
        las = laspy.read(tmp_path / file)
        first = np.asarray(las.return_number) == 1
        label = np.asarray(las.classification)[first]
        share.append((label == 5).sum() / np.isin(label, (2, 5)).sum())
    for porosity, found in zip((0.35, 0.8), share[1:]):
        assert found / share[0] == pytest.approx(1.0 - porosity * (1.0 - INSIDE), abs=0.02)


def crowns_of(city: CitySpec, bits: int) -> np.ndarray:
    s = prepare(city, city.scenes[0]).surfaces
    return s.trees[s.tree_view == bits]


def test_a_bare_view_sees_the_ground_below_crowns() -> None:
    shown = {view: shown_by(BARE_RIGHT, view) for view in ("left", "right")}
    share = {view: (of["surface"] == TREE).mean() for view, of in shown.items()}
    leafy = (shown_by(WOODED, "right")["surface"] == TREE).mean()
    assert leafy > 0.1 and share["left"] > 0.1 and 0.002 < share["right"] < 0.2 * leafy
    # leaves of the left view are in the right one neither shown nor behind something
    leaves = shown["left"]["surface"] == TREE
    assert not shown["left"]["visible_right"][leaves].any()
    assert not shown["left"]["hidden_right"][leaves].any()
    # what the bare view shows below a crown is ground that the LiDAR has a crown over
    right = shown["right"]
    below = (right["surface"] == GROUND) & (right["changed"] == 1)
    assert below.mean() > 0.5 * leafy
    assert len(crowns_of(BARE_RIGHT, IN_RIGHT)) == BOUGHS * len(
        crowns_of(WOODED, IN_IMAGES | IN_LIDAR)
    ) // (CANOPY.lobes + 1)
    assert len(crowns_of(BARE_RIGHT, IN_LEFT | IN_LIDAR)) == len(
        crowns_of(WOODED, IN_IMAGES | IN_LIDAR)
    )
