"""Windows of one surface alone: planes among crowns, and pixels that show nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.align.tie_planes import GUARDS, HALF, SIDE, SitePoints

WIDE = 120
CENTRE = np.array([60, 60])
TWICE = np.array([CENTRE, CENTRE])
PARALLAX = np.array([-0.2, 0.9])  # px/m
LEVEL, SLOPES = 50.0, np.array([0.11, -0.06])  # m, m/px


def ground(rng: np.random.Generator, per_px: float) -> np.ndarray:
    """(col, row, height) [n, 3] of points on a plane, 0.03 m of noise."""
    at = rng.uniform(0, WIDE - 1, (int(per_px * WIDE**2), 2))
    height = LEVEL + (at - CENTRE) @ SLOPES + rng.normal(0, 0.03, len(at))
    return np.column_stack([at, height])


def crown(rng: np.random.Generator, middle: tuple[float, float], radius: float, n: int):
    """Points 2 to 5 m above the plane, within a disc."""
    turn, r = rng.uniform(0, 2 * np.pi, n), radius * np.sqrt(rng.uniform(0, 1, n))
    at = np.array(middle) + np.column_stack([r * np.cos(turn), r * np.sin(turn)])
    return np.column_stack([at, LEVEL + (at - CENTRE) @ SLOPES + rng.uniform(2, 5, n)])


def points_of(cloud: np.ndarray, firm: np.ndarray | None = None) -> SitePoints:
    firm = np.ones(len(cloud), bool) if firm is None else firm
    return SitePoints.sorted(*cloud.T.copy(), firm, (WIDE, WIDE), PARALLAX)


@pytest.mark.parametrize("per_px", [0.11, 2.0])
def test_a_third_of_crowns_does_not_tilt_a_plane(per_px):
    rng = np.random.default_rng(7)
    cloud = ground(rng, per_px)
    inside = np.abs(cloud[:, :2] - CENTRE).max(axis=1) <= HALF
    n = int(0.4 * inside.sum())
    cloud = np.vstack([cloud, crown(rng, (66.0, 55.0), 5.0, n)])
    planes, share = points_of(cloud).fit_planes(CENTRE[None])
    assert planes[0, 0] == pytest.approx(LEVEL, abs=0.03)
    assert planes[0, 1:3] == pytest.approx(SLOPES, abs=0.006)
    assert planes[0, 3] == pytest.approx(0.03, rel=0.5)
    assert share[0] == pytest.approx(inside.sum() / (inside.sum() + n), abs=0.06)


@pytest.mark.parametrize("number", range(len(GUARDS)))
def test_what_stands_off_the_plane_is_left_out_where_either_view_shows_it(number):
    guard = GUARDS[number]
    rng = np.random.default_rng(9)
    cloud = np.vstack([ground(rng, 2.0), [[60.0, 55.0, LEVEL + 5.0 - 5 * SLOPES[1]]]])
    points = points_of(cloud)
    planes, _ = points.fit_planes(TWICE)
    clear = points.clear_pixels(TWICE, planes)[number, 0]
    row, col = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    # The point is 5 m high: at (0, -5) in the left image, at (-1, -0.5) in the right one.
    away = np.min(
        [np.hypot(col + t * 1.0, row + 5.0 - t * 4.5) for t in np.linspace(0, 1, 50)], axis=0
    )
    reach = guard.px + guard.spacings * SIDE / np.sqrt(2.0 * SIDE**2)
    assert not clear[away < reach - 1.0].any()
    assert clear[away > reach + 1.0].mean() > 0.99


def test_a_pulse_of_several_returns_and_a_hole_are_left_out():
    rng = np.random.default_rng(10)
    cloud = ground(rng, 2.0)
    several = np.hypot(*(cloud[:, :2] - (65.0, 65.0)).T) < 1.0
    hole = np.hypot(*(cloud[:, :2] - (54.0, 54.0)).T) < 5.0
    points = points_of(cloud[~hole], ~several[~hole])
    planes, _ = points.fit_planes(TWICE)
    clear = points.clear_pixels(TWICE, planes)[0, 0]
    row, col = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    assert not clear[np.hypot(col - 5, row - 5) < 2.5].any()
    assert not clear[np.hypot(col + 6, row + 6) < 2.0].any()
    assert clear[row > 8].mean() > 0.9 and clear[col > 9].mean() > 0.9
