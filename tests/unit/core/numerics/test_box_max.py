"""Greatest values around places, against a loop."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.windows import box_max


@pytest.mark.parametrize("kind", [bool, np.int64, np.float64])
@pytest.mark.parametrize("reach", [0, 1, 3, 11])
def test_squares_are_cut_off_at_the_edges(kind: type, reach: int) -> None:
    values = (np.random.default_rng(3).random((7, 9)) * 8).astype(int).astype(kind)
    expected = [
        [
            values[max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1].max()
            for i in range(9)
        ]
        for j in range(7)
    ]
    assert np.array_equal(box_max(values, reach), expected)
