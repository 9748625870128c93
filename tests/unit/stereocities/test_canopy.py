"""Crowns of a canopy: their surface, number, pulses and leaves, against what geometry asks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from stereocities.camera import rays
from stereocities.cities import CitySpec, lidar_files
from stereocities.lidar import INSIDE, simulate_lidar_tile
from stereocities.objects import BOUGHS
from stereocities.render import prepare
from stereocities.surfaces import IN_IMAGES, IN_LEFT, IN_LIDAR, IN_RIGHT, terrain_heights
from stereocities.world import build_surfaces

from ...synthetic.small_cities import GROUND, TREE
from ...synthetic.wooded_cities import BARE_RIGHT, CANOPY, OPEN, WOODED, shown_by


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
