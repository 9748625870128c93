"""Sorting by pixel against a loop over points."""

from __future__ import annotations

import numpy as np

from stereotruth.labels.pair_window import read_patch
from stereotruth.labels.window_points import PX, Collection, PixelPoints

ROWS, COLS = slice(10, 50), slice(30, 90)
ORIGIN = (1000, 2000)


def collected(lattice: np.ndarray, xy: np.ndarray, order: np.ndarray) -> PixelPoints:
    image = np.full((60, 120), 100, np.uint16)
    image[20:24, 50:53] = 0
    left, right = (
        read_patch(image, ROWS, COLS, 1),
        read_patch(image, ROWS, slice(0, 120), 1),
    )
    shape = ROWS.stop - ROWS.start, COLS.stop - COLS.start
    collection = Collection(shape, (ROWS.start, COLS.start), ORIGIN, left, right)
    for part in np.array_split(order, 7):
        surface_class, day = ((lattice[0, part] % n).astype(np.uint8) for n in (7, 251))
        points = np.ascontiguousarray(lattice[:, part])
        collection.add(*points, surface_class, day, xy[:, part].copy())
    return collection.sorted()


def test_each_pixel_has_its_points() -> None:
    rng = np.random.default_rng(0)
    n = 20_000
    x, y = rng.uniform(25, 95, n), rng.uniform(5, 55, n)
    xy = np.stack([x, y, x - rng.uniform(5, 9, n), y + rng.uniform(-0.01, 0.01, n)])
    xy[:, 0] = np.nan
    lattice = rng.integers(-5000, 5000, (3, n))
    window = collected(lattice, xy, np.arange(n))
    shuffled = collected(lattice, xy, rng.permutation(n))
    assert np.array_equal(window.start, shuffled.start)
    assert np.array_equal(window.outside, shuffled.outside)
    pixel = np.repeat(np.arange(window.start.size - 1), np.diff(window.start))
    points = window.points
    x_left, y_left = pixel % 60 + 30 + points["u"] / PX, pixel // 60 + 10 + points["v"] / PX
    x_right, y_right = x_left - points["disparity"] / PX, y_left + points["parallax"] / PX
    found = np.stack([x_left, y_left, x_right, y_right])
    col, row = np.floor(x + 0.5), np.floor(y + 0.5)
    inside = (col >= 30) & (col < 90) & (row >= 10) & (row < 50)
    inside[0] = False
    assert window.count.sum() + window.outside.sum() == inside.sum()
    # Nodata: what an interpolation at the left or the right place would touch.
    hole = np.zeros(n, bool)
    for a, b in (xy[:2], xy[2:]):
        hole |= (a >= 49) & (a < 53) & (b >= 19) & (b < 24)
    assert window.outside.sum() == (hole & inside).sum()
    for p in rng.integers(0, window.start.size - 1, 300):
        i, j = p % 60 + 30, p // 60 + 10
        members = np.flatnonzero(inside & ~hole & (col == i) & (row == j))
        here = slice(window.start[p], window.start[p + 1])
        assert sorted(window.points["height"][here]) == sorted(lattice[2, members])
        again = slice(shuffled.start[p], shuffled.start[p + 1])
        order, other = (np.argsort(w["lon"]) for w in (window.points[here], shuffled.points[again]))
        assert np.array_equal(window.points[here][order], shuffled.points[again][other])
        by_lon = np.argsort(lattice[0, members])
        assert np.array_equal(window.points["lon"][here][order], lattice[0, members[by_lon]] - 1000)
        assert np.array_equal(window.points["lat"][here][order], lattice[1, members[by_lon]] - 2000)
        assert (
            np.abs(found[:, here][:, order] - xy[:, members[by_lon]]).max(initial=0.0) <= 1.01 / PX
        )
        for name, n in (("surface_class", 7), ("day", 251)):
            found_here = window.points[name][here][order]
            assert np.array_equal(found_here, lattice[0, members[by_lon]] % n)
