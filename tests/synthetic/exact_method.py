"""A stereo method that knows the truth, but for its margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SHAPE = (150, 230)


@dataclass
class Exact:
    """Reads the disparity from images of three bands, and spoils what lies in its margin.

    Bands: the right column that a pixel corresponds to, its row, its column, each + 1.
    """

    margin_px: int = 10
    spread: float = 0.0  # of a constant that each tile is off by

    def __call__(self, left, right, disparity_range, scaling=None):
        assert left.shape == right.shape
        assert scaling == "whole"
        codes = right[..., 0].max(axis=0)
        known = np.flatnonzero(codes)
        column = left[..., 0] - codes[known[0]] + known[0]  # in the right part
        found = np.arange(left.shape[1]) - column
        low, high = disparity_range
        bad = (left[..., 0] == 0) | (found < low) | (found >= high)
        bad |= (column < -0.01) | (column > left.shape[1] - 0.99)
        found = np.where(bad, np.nan, found)
        rows, cols = (left[..., k][left[..., k] > 0] for k in (1, 2))
        m = self.margin_px  # where the image goes on beyond its part, there is no truth
        for edge, goes_on in (
            (np.s_[:m], rows.min() > 1),
            (np.s_[-m:], rows.max() < SHAPE[0]),
            (np.s_[:, :m], cols.min() > 1 and codes[0] > 1),
            (np.s_[:, -m:], cols.max() < SHAPE[1] and 0 < codes[-1] < SHAPE[1]),
        ):
            found[edge] += 0.7 * goes_on
        tile = left[left.shape[0] // 2, left.shape[1] // 2, 2]
        return (found + self.spread * np.sin(0.1 * tile)).astype(np.float32)

    def scaling(self, left, right):
        return "whole"


def coded(disparity):
    """Left and right image of a disparity, for Exact, and where it can be told."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    column = x - disparity
    inside = (column >= 0) & (column <= SHAPE[1] - 1)
    left = np.dstack([np.where(inside, column + 1, 0), y + 1, x + 1])
    right = np.dstack([x + 1, y + 1, x + 1])
    return left.astype(np.float32), right.astype(np.float32), inside


def plane_with_step():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 0.05 * x - 0.03 * y + np.where((x > 90) & (y > 40), 7.0, 0.0)
