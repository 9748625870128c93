"""What images show of facets and prisms, against rays through each pixel's centre."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.lidar.lattice import LATTICE_M
from stereotruth.surface.raster import (
    FACET_IN_RIGHT,
    OCCLUSION_TOLERANCE_PX,
    PRISM_IN_LEFT,
    PRISM_IN_RIGHT,
    VISIBLE,
    ProjectedSurface,
)
from stereotruth.surface.surface import GroundSurface, RoughTops
from stereotruth.surface.vertices import Vertices

SHAPE, FIRST = (24, 30), (5, -3)
PX_PER_M = 0.8
NONE = RoughTops(np.empty((0, 3), np.int32), np.empty(0), np.empty(0, np.int64), np.empty(0, bool))


class Affine:
    """Lattice steps of 1e-4 degrees are px here; the left image looks down, the right one not."""

    def with_rise(self, lon_q, lat_q, h_q, lifted):
        x, y, d = lon_q / 1e4, lat_q / 1e4, h_q * LATTICE_M * PX_PER_M
        rise = np.zeros((4, x.size), np.float32)
        rise[2] = -LATTICE_M * PX_PER_M
        return np.stack([x, y, x - d, y]), rise


def surface_of(corners: np.ndarray, undecided: int) -> GroundSurface:
    """Of triangles [m, 3, 3] (x, y in px, height in m), the last of which are ``undecided``."""
    flat = np.rint(corners.reshape(-1, 3) * [1e4, 1e4, 1 / LATTICE_M]).astype(np.int64)
    count = np.ones(len(flat), np.int32)
    of_points = count.astype(np.uint8), count, count.astype(np.uint16)
    vertices = Vertices(*flat.T.copy(), *(np.zeros(len(flat), np.int64),) * 2, *of_points)
    corner = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    facet, open_ = np.split(corner, [len(corner) - undecided])
    heights = flat[open_, 2]
    return GroundSurface(
        vertices, facet, *np.float32([np.ones(len(facet)), np.zeros(len(facet))]), open_,
        np.stack([heights.min(axis=1), heights.max(axis=1)], axis=1), len(open_), NONE,
        facet[:, 0].copy(), open_[:, 0].copy(),
    )  # fmt: skip


def at(triangle: np.ndarray, x: np.ndarray, y: float) -> np.ndarray:
    """Height [n] of a triangle [3, 3] over places, NaN beside it."""
    a, b, c = triangle
    system = np.array([b - a, c - a])[:, :2].T
    shares = np.linalg.solve(system, np.array([x - a[0], np.full(x.shape, y - a[1])]))
    inside = (shares >= 0.0).all(axis=0) & (shares.sum(axis=0) <= 1.0)
    return np.where(inside, a[2] + shares.T @ np.array([b[2] - a[2], c[2] - a[2]]), np.nan)


def ray_meets(triangle: np.ndarray, x: float, y: float, d: float, prism: bool) -> bool:
    """Whether a triangle, or the prism over it, covers the surface of disparity ``d`` at a place
    from the right camera, to which the ray rises by 1 / PX_PER_M m a px."""
    rise = np.arange(OCCLUSION_TOLERANCE_PX, 12.0, 0.005)
    height = at(triangle, x + rise, y)
    ray = (d + rise) / PX_PER_M
    low, top = (triangle[:, 2].min(), triangle[:, 2].max()) if prism else (height, height)
    step = 0.0 if prism else 0.02
    return bool((np.isfinite(height) & (ray >= low - step) & (ray <= top + step)).any())


def test_both_views_see_what_rays_meet() -> None:
    rng = np.random.default_rng(1)
    ground = np.array(
        [[[-9, 0, 0], [40, 0, 0], [-9, 40, 2]], [[40, 0, 0], [40, 40, 4], [-9, 40, 2]]]
    )
    raised = rng.uniform([-2, 6, 3], [26, 28, 9], (6, 3, 3)).round(2)
    surface = surface_of(np.concatenate([ground, raised]), 2)
    triangles = np.concatenate([ground, raised])
    projected = ProjectedSurface.of(surface, Affine(), FIRST)
    left = projected.seen(SHAPE, PX_PER_M)
    both = left.from_both_cameras()
    known, agree = 0, []
    for j in range(SHAPE[0]):
        for i in range(SHAPE[1]):
            x, y = float(i + FIRST[1]), float(j + FIRST[0])
            heights = np.array([at(t, np.array([x]), y)[0] for t in triangles[:-2]])
            prisms = [
                t[:, 2].max() for t in triangles[-2:] if np.isfinite(at(t, np.array([x]), y)[0])
            ]
            highest = np.nanmax(heights)
            assert left.height[j, i] == pytest.approx(highest, abs=1e-3)
            open_ = max(prisms, default=-9.0) * PX_PER_M > highest * PX_PER_M + 0.25
            assert left.visibility[j, i] == (PRISM_IN_LEFT if open_ else VISIBLE)
            if open_:
                continue
            d = highest * PX_PER_M
            by_facet = any(ray_meets(t, x, y, d, False) for t in triangles[:-2])
            by_prism = any(ray_meets(t, x, y, d, True) for t in triangles[-2:])
            expected = FACET_IN_RIGHT if by_facet else PRISM_IN_RIGHT if by_prism else VISIBLE
            turned = 1.0 - both.slope[0, j, i] < 0.3
            agree.append(both.visibility[j, i] == (FACET_IN_RIGHT if turned else expected))
            known += expected != VISIBLE
    assert known > 10 and np.mean(agree) > 0.99  # rays are walked in steps


def test_an_edge_is_near_as_far_as_asked() -> None:
    """A roof over level ground, without walls; beyond both there is nothing."""
    roof = np.array([[[4, 8, 5], [14, 8, 5], [4, 18, 5]], [[14, 8, 5], [14, 18, 5], [4, 18, 5]]])
    ground = np.array(
        [[[-9, 0, 0], [40, 0, 0], [-9, 25, 0]], [[40, 0, 0], [40, 25, 0], [-9, 25, 0]]]
    )
    triangles = np.concatenate([ground, roof]) + np.array([0.3, 0.3, 0.0])
    surface = surface_of(triangles, 0)
    seen = ProjectedSurface.of(surface, Affine(), FIRST).seen(SHAPE, PX_PER_M)
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = col + FIRST[1] - 0.3, row + FIRST[0] - 0.3
    across = np.maximum(np.maximum(4 - x, x - 14), np.maximum(8 - y, y - 18))
    expected = (np.abs(across) < 0.5) | (np.abs(y - 25) < 0.5)
    corners = (np.minimum(np.abs(x - 4), np.abs(x - 14)) < 1) & (
        np.minimum(np.abs(y - 8), np.abs(y - 18)) < 1
    )
    near = seen.projected.near_edge(seen.disparity, seen.slope, 0.5, surface.facet, slice(None))
    assert near.any() and np.array_equal(near[~corners], (expected & (y < 25))[~corners])
