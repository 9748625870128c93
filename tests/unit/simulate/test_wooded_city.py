"""Crowns of a canopy, suns of the views, leaves, vehicles: what they must do by geometry."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from stereotruth.simulate.appearance import VEHICLE
from stereotruth.simulate.camera import rays
from stereotruth.simulate.canopy import BOUGHS
from stereotruth.simulate.cities import Canopy, CitySpec, ViewSpec, lidar_files
from stereotruth.simulate.lidar import INSIDE, simulate_lidar_tile
from stereotruth.simulate.render import _shade_rows, prepare
from stereotruth.simulate.surfaces import (
    IN_IMAGES,
    IN_LEFT,
    IN_LIDAR,
    IN_RIGHT,
    direction_of_sun,
    terrain_heights,
)
from stereotruth.simulate.truth import truth_at
from stereotruth.simulate.world import build_surfaces

from ...synthetic.small_cities import GROUND, ONE_BOX, TOWN, TREE

CANOPY = Canopy(ground_m2=150.0, radius_m=(2.0, 4.0))
WOODED = replace(
    TOWN, name="Wooded", character=replace(TOWN.character, trees=0.0, canopy=CANOPY, river_m=0.0)
)
BARE_RIGHT = replace(WOODED, right=ViewSpec(bare=True))
OPEN = replace(
    WOODED, character=replace(WOODED.character, zones={"fields": 1}, buildings=0.0, relief_m=0.0)
)


def shown_by(city: CitySpec, view: str, step: float = 3.0) -> dict[str, np.ndarray]:
    scene = city.scenes[0]
    ready = prepare(city, scene)
    camera = getattr(ready, view)
    at = np.meshgrid(np.arange(20.0, camera.cols - 20, step), np.arange(20, camera.rows - 20, step))
    col, row = (a.ravel() for a in at)
    return {"col": col, "row": row, **truth_at(city, scene, col, row, view)}


def crowns_of(city: CitySpec, bits: int) -> np.ndarray:
    s = prepare(city, city.scenes[0]).surfaces
    return s.trees[s.tree_view == bits]


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


def test_rough_crowns_are_rougher_than_smooth_ones_and_no_wider() -> None:
    smooth = replace(OPEN, character=replace(OPEN.character, canopy=replace(CANOPY, lobes=0)))
    whole, parts = build_surfaces(smooth).trees, build_surfaces(OPEN).trees
    assert len(parts) == (CANOPY.lobes + 1) * len(whole)
    lobes = parts[len(whole) :].reshape(len(whole), CANOPY.lobes, 6)
    away = np.hypot(*(lobes[..., :2] - whole[:, None, :2]).transpose(2, 0, 1))
    assert (away + lobes[..., 3] <= whole[:, None, 3] * (1 + 1e-9)).all()
    assert (lobes[..., 2] + lobes[..., 4] <= whole[:, None, 2] + whole[:, None, 4] + 1e-9).all()
    height = [shown_by(city, "left", 1.0) for city in (smooth, OPEN)]
    # second differences along a row where both show the same crown's middle
    bend = []
    for shown in height:
        rows = shown["height"].reshape(len(np.unique(shown["row"])), -1)
        tree = (shown["surface"] == TREE).reshape(rows.shape)
        inner = tree[:, :-2] & tree[:, 1:-1] & tree[:, 2:]
        bend.append(np.median(np.abs(np.diff(rows, 2, axis=1))[inner]))
    assert bend[1] > 1.2 * bend[0]


def test_a_canopy_has_as_many_crowns_as_it_says() -> None:
    area = np.prod(build_surfaces(OPEN).cell_top.shape) * 64.0
    for arrangement in ("single", "rows", "forest"):
        canopy = replace(CANOPY, arrangement=arrangement, lobes=0)
        city = replace(OPEN, character=replace(OPEN.character, canopy=canopy), margin_m=400.0)
        s = build_surfaces(city)
        near = np.abs(s.trees[:, :2]).max(axis=1) < 250.0  # all of it within the margin
        expected = 500.0**2 / CANOPY.ground_m2
        assert near.sum() == pytest.approx(expected, rel=0.5 if arrangement == "forest" else 0.1)
        cells = np.histogram2d(*s.trees[near, :2].T, bins=16)[0]
        clustering = cells.var() / cells.mean()
        assert (clustering > 2.0) == (arrangement == "forest")
    assert area > 0


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
    ready = prepare(BARE_RIGHT, BARE_RIGHT.scenes[0])
    xyz = ready.frame.from_geodetic(
        np.column_stack([right[n][below] for n in ("lon", "lat", "height")])
    )
    z = terrain_heights(ready.surfaces, xyz[:, :2])[:, 0]
    assert np.abs(z - xyz[:, 2]).max() < 2e-3
    assert len(crowns_of(BARE_RIGHT, IN_RIGHT)) == BOUGHS * len(
        crowns_of(WOODED, IN_IMAGES | IN_LIDAR)
    ) // (CANOPY.lobes + 1)
    assert len(crowns_of(BARE_RIGHT, IN_LEFT | IN_LIDAR)) == len(
        crowns_of(WOODED, IN_IMAGES | IN_LIDAR)
    )


def test_dark_crowns_are_dark_by_the_factor() -> None:
    bright, dark = (
        replace(OPEN, character=replace(OPEN.character, canopy=replace(CANOPY, brightness=b)))
        for b in (1.0, 0.5)
    )
    shown = shown_by(OPEN, "left", 1.0)
    at = np.rint(np.column_stack([shown["row"], shown["col"]])).astype(int)
    values = []
    for city in (bright, dark):
        camera = prepare(city, city.scenes[0]).left
        half = np.empty((2 * camera.rows, 2 * (camera.cols + 4)), np.float32)
        _shade_rows(camera.surfaces, camera.horizon, camera.shown, camera.cam, 0.0, half)
        values.append(half[2 * at[:, 0], 2 * at[:, 1] + 4])
    ratio = values[1] / values[0]
    tree, ground = shown["surface"] == TREE, shown["surface"] == GROUND
    assert np.median(ratio[tree]) == pytest.approx(0.5, abs=0.01)
    assert np.median(ratio[ground]) == 1.0


def test_shadows_of_a_view_fall_away_from_its_own_sun() -> None:
    """The shadow of one box of 50 m by 40° of elevation: its length and direction."""
    views = {"left": (200.0, 40.0), "right": (140.0, 40.0)}
    city = replace(ONE_BOX, **{view: ViewSpec(sun_deg=sun) for view, sun in views.items()})
    x, y, _, _, height = city.single_box
    for view, (azimuth, elevation) in views.items():
        scene = city.scenes[0]
        camera = getattr(prepare(city, scene), view)
        assert camera.surfaces.sun == pytest.approx(direction_of_sun(azimuth, elevation))
        half = np.empty((2 * camera.rows, 2 * (camera.cols + 4)), np.float32)
        _shade_rows(camera.surfaces, camera.horizon, camera.shown, camera.cam, 0.0, half)
        shown = shown_by(city, view, 1.0)
        at = np.rint(np.column_stack([shown["row"], shown["col"]])).astype(int)
        bright = half[2 * at[:, 0], 2 * at[:, 1] + 4]
        frame = prepare(city, scene).frame
        xyz = frame.from_geodetic(np.column_stack([shown[n] for n in ("lon", "lat", "height")]))
        long = height / math.tan(math.radians(elevation))
        away = math.radians(azimuth + 180.0)
        end = np.array([x, y]) + 0.9 * long * np.array([math.sin(away), math.cos(away)])
        beside = np.array([x, y]) - 0.9 * long * np.array([math.sin(away), math.cos(away)])
        ground = shown["surface"] == GROUND
        dark = np.hypot(*(xyz[:, :2] - end).T) < 4
        lit = np.hypot(*(xyz[:, :2] - beside).T) < 4
        assert (ground & dark).sum() > 20 and (ground & lit).sum() > 20
        assert np.median(bright[ground & dark]) < 0.5 * np.median(bright[ground & lit])


def test_vehicles_are_elsewhere_in_each_view() -> None:
    city = replace(TOWN, name="Busy", character=replace(TOWN.character, vehicles=40.0))
    s, none = build_surfaces(city), build_surfaces(TOWN)
    cars = s.box_style[:, 2] == VEHICLE
    np.testing.assert_array_equal(s.boxes[~cars], none.boxes)
    np.testing.assert_array_equal(s.trees, none.trees)
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


def test_buildings_are_as_many_as_the_share_and_flat_where_asked() -> None:
    half = replace(TOWN, character=replace(TOWN.character, buildings=0.5, flat_roofs=True))
    few, all_of_them = build_surfaces(half), build_surfaces(TOWN)
    assert 0.35 < len(few.boxes) / len(all_of_them.boxes) < 0.65
    assert (few.boxes[:, 7] == 0).all() and (all_of_them.boxes[:, 7] > 0).any()
