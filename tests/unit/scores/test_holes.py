"""Holes of disparity maps: filled along the rows with what is further down."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.scores.holes import fill_holes

N = np.nan


def test_a_hole_takes_the_lower_of_its_two_sides():
    found = fill_holes(np.array([[N, 5, N, N, 2, N, 7, N]], np.float32))
    assert found.tolist() == [[5, 5, 2, 2, 2, 2, 7, 7]]
    turned = fill_holes(np.array([[N, 5, N, N, 2, N, 7, N]], np.float32), grows_with_height=False)
    assert turned.tolist() == [[5, 5, 5, 5, 2, 7, 7, 7]]


def test_empty_rows_take_the_nearest_one():
    rows = [[N, N], [1, N], [N, N], [N, N], [N, 9], [N, N]]
    found = fill_holes(np.array(rows, np.float32))
    assert found[:, 0].tolist() == [1, 1, 1, 9, 9, 9]
    middle = fill_holes(np.array([[1], [N], [9]], np.float32))
    assert middle[:, 0].tolist() == [1, 1, 9]  # of two the upper


def test_an_empty_map_takes_the_given_value():
    assert fill_holes(np.full((2, 3), N, np.float32), 4.5).tolist() == [[4.5] * 3] * 2


@pytest.mark.parametrize("grows", [True, False])
def test_against_a_loop(grows):
    rng = np.random.default_rng(3)
    disparity = rng.normal(0, 9, (40, 30)).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.7] = N
    disparity[[0, 11, 12, 39]] = N
    before = disparity.copy()
    found = fill_holes(disparity, grows_with_height=grows)
    lower = min if grows else max
    full = [r for r in range(40) if np.isfinite(disparity[r]).any()]
    for r in range(40):
        row = disparity[min(full, key=lambda n: (abs(n - r), n))]
        for c in range(30):
            sides = [side[np.isfinite(side)] for side in (row[: c + 1][::-1], row[c:])]
            assert found[r, c] == lower(float(side[0]) for side in sides if side.size)
    assert np.array_equal(disparity, before, equal_nan=True)
    assert np.array_equal(fill_holes(found), found)
