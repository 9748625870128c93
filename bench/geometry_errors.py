"""How far alignment and epipolar model alone are off, by exact points of a synthetic scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereotruth.epipolar.model import EpipolarModel
from stereotruth.numerics.error_sums import ErrorSum
from stereotruth.products.grids import require_complete

ROWS = 1024  # of the raw image that are read at a time


def geometry_errors(
    model: EpipolarModel, raw_truth: str | Path, *, step: int = 7
) -> tuple[ErrorSum, ErrorSum]:
    """Errors of (disparity, y-parallax), px.

    The exact ground points of every ``step``-th raw pixel that both views see go through the
    pipeline's sensor models. The first is the error of a label on an exact point, compared with
    the truth of the same pixel; the second the y-parallax of the true correspondences.
    ``raw_truth``: the truth on the raw left image's grid.
    """
    group = require_complete(raw_truth)
    disparity, parallax = ErrorSum(), ErrorSum()
    height, width = group["right_col"].shape
    for top in range(0, height, ROWS):
        window = np.s_[top : min(top + ROWS, height)]
        thin = np.s_[-top % step :: step, ::step]
        seen = np.asarray(group["visible_right"][window])[thin] == 1
        row, col = np.mgrid[window, 0:width]
        row, col = row[thin][seen].astype(float), col[thin][seen].astype(float)
        lon, lat, h, right_col, right_row = (
            np.asarray(group[name][window], dtype=np.float64)[thin][seen]
            for name in ("lon", "lat", "height", "right_col", "right_row")
        )
        x_left, y_left = model.left_to_epipolar(col, row)
        x_right, y_right = model.right_to_epipolar(right_col, right_row)
        found = model.ground_to_epipolar(lon, lat, h)
        disparity.add(found[0] - found[2] - (x_left - x_right))
        parallax.add(y_right - y_left)
    return disparity, parallax
