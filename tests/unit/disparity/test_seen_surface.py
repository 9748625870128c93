"""What the centre of a pixel sees, against the definition in plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.pixel_points import POINT, PX, PixelPoints
from stereotruth.disparity.seen_surface import COVER_PX, MANY, MAX_COVER_PX, seen_surface
from stereotruth.epipolar.window_sums import SURFACE_PX


def window_of(x: np.ndarray, y: np.ndarray, disparity: np.ndarray, side: int) -> PixelPoints:
    """Points at px of a square window whose first pixel is (0, 0)."""
    steps = [np.rint(value * PX).astype(np.int64) for value in (x, y, disparity)]
    col, row = ((value + PX // 2) // PX for value in steps[:2])
    order = np.argsort(row * side + col, kind="stable")
    points = np.zeros(x.size, POINT)
    points["u"], points["v"] = steps[0] - col * PX, steps[1] - row * PX
    points["disparity"] = steps[2]
    count = np.bincount(row * side + col, minlength=side * side)
    start = np.concatenate([[0], np.cumsum(count)])
    outside = np.zeros(side * side, np.int32)
    masked = np.zeros(side * side, np.bool_)
    return PixelPoints(points[order], start, outside, masked, (side, side), (0, 0), (0, 0))


def gap(angles: np.ndarray) -> int:
    """Most octants in a row without a direction."""
    octants = set((np.floor(angles / (np.pi / 4)) % 8).astype(int).tolist())
    ring = "".join("x" if k % 8 in octants else "." for k in range(16))
    return 8 if not octants else max(len(run) for run in ring.split("x"))


def seen_by_definition(window: PixelPoints, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Point by point, from the docstring of seen_surface."""
    side = window.shape[0]
    pixel = np.repeat(np.arange(side * side), np.diff(window.start))
    row, col = pixel // side, pixel % side
    x, y = col + window.points["u"] / PX, row + window.points["v"] / PX
    d = window.points["disparity"] / PX
    parts = np.stack([np.floor((x + 0.5) * 4), np.floor((y + 0.5) * 4)], axis=1)
    tops: dict[tuple[float, float], float] = {}
    for place, disparity in zip(map(tuple, parts), d):
        tops[place] = max(tops.get(place, -np.inf), disparity)
    centres = (np.array(list(tops)) + 0.5) / 4 - 0.5
    highest = np.array(list(tops.values()))
    uncovered = np.ones(d.size, bool)
    for k in range(d.size):
        near = (abs(row - row[k]) <= 1) & (abs(col - col[k]) <= 1)
        reach = np.clip(1.7 * 3 / np.sqrt(near.sum()), COVER_PX, MAX_COVER_PX)
        away = centres - (x[k], y[k])
        above = (highest > d[k] + SURFACE_PX) & ((away**2).sum(axis=1) <= reach**2)
        uncovered[k] = gap(np.arctan2(away[above, 1], away[above, 0])) > 3
    use, edge = np.zeros(d.size, bool), np.zeros((side, side), bool)
    for p in range(side * side):
        near = uncovered & (abs(row - p // side) <= 1) & (abs(col - p % side) <= 1)
        if not (near & (pixel == p)).any():
            continue
        away = np.stack([x - p % side, y - p // side])
        distance = np.hypot(*away)
        nearest = np.flatnonzero(near)[np.argmin(distance[near])]
        same = near & (abs(d - d[nearest]) <= SURFACE_PX)
        use |= same & (pixel == p)
        gaps = gap(np.arctan2(away[1, same], away[0, same])) > 3 and near.sum() >= MANY
        other = distance[near & ~same].min(initial=np.inf)
        edge.flat[p] = gaps or other < distance[nearest] + 2 * margin
        edge.flat[p] &= (same & (pixel == p)).any()
    return use, edge


@pytest.mark.parametrize("density", [0.7, 3.0, 9.0])
@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_seen_surface_is_that_of_its_definition(density, margin) -> None:
    """A roof and posts on sloping ground, point by point; the same in any order of the points."""
    side = 26
    rng = np.random.default_rng(6)
    n = int(density * side * side)
    x, y = rng.uniform(-0.49, side - 0.51, (2, n))
    roof = (x > 8.3) & (y > 6.7) & (x < 17.2)
    disparity = 0.3 * x + rng.normal(0, 0.1, n) + np.where(roof, 9.0, 0.0)
    disparity += np.where(rng.random(n) < 0.1, 5.0, 0.0)
    window = window_of(x, y, disparity, side)
    use, edge = seen_surface(window, margin)
    expected_use, expected_edge = seen_by_definition(window, margin)
    assert 0.3 < use.mean() < 0.99
    assert 0 < edge.sum() < side * side - 10
    assert np.array_equal(use, expected_use)
    assert np.array_equal(edge, expected_edge)
    order = rng.permutation(n)
    again = window_of(x[order], y[order], disparity[order], side)
    found = seen_surface(again, margin)
    assert np.array_equal(found[1], edge)
    assert sorted(again.points["disparity"][found[0]]) == sorted(window.points["disparity"][use])
