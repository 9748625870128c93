"""Sums and greatest values over windows, against those that are taken one by one."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.windows import box_max, summed_area, window_sums


@pytest.mark.parametrize("kind", [bool, np.int32, float])
def test_sums_and_maxima_of_windows(kind):
    values = (np.random.default_rng(2).uniform(0, 3, (6, 9))).astype(kind)
    for size in (1, 3, 6):
        found = window_sums(values, size)
        assert found.shape == (7 - size, 10 - size)
        for (row, col), total in np.ndenumerate(found):
            expected = values[row : row + size, col : col + size].sum()
            assert total == pytest.approx(expected, rel=1e-12)
    for reach in (0, 1, 11):
        for (row, col), most in np.ndenumerate(box_max(values, reach)):
            rows, cols = (slice(max(n - reach, 0), n + reach + 1) for n in (row, col))
            assert most == values[rows, cols].max()


def test_whole_numbers_are_summed_exactly_beyond_their_type():
    values = np.full((400, 300), 255, np.uint8)
    assert summed_area(values)[-1, -1] == 255 * 400 * 300


def test_a_window_larger_than_the_grid_is_nowhere():
    assert window_sums(np.ones((3, 5)), 4).shape == (0, 2)
    assert window_sums(np.ones((3, 5)), 9).size == 0
