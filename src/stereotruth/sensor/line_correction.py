"""What an image's lines are off by: an attitude that jitters, which no RPC follows.

Every line of a pushbroom image is taken at its own time, with its own roll and pitch. The
correction moves a whole line along its columns and across them. It is no part of the kernels: they
know the smooth sensor, and the correction is added where a position in the image itself is asked
for. So all polynomials of the smooth sensor stay as exact as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.numerics.interpolation import cubic_weights

Floats = NDArray[np.float64]


ROUNDS = 12  # of the inverse: each leaves a hundredth where a line is off by 0.01 px per line
MEANING = (
    "(col, row)_image = (col, row) + (C(row), R(row)), px, (col, row) being that of RPC and "
    "affine. C and R are uniform cubic B-splines with n coefficients c[i] on [row_min, row_max]: "
    "s = (row - row_min) / (row_max - row_min) * (n - 3), i0 = min(floor(s), n - 4), f = s - i0, "
    "sum over a in 0..3 of w_a(f) c[i0 + a], w_0(f) = (1 - f)^3 / 6, w_1(f) = (3 f^3 - 6 f^2 + 4) "
    "/ 6, w_2(f) = (-3 f^3 + 3 f^2 + 3 f + 1) / 6, w_3(f) = f^3 / 6; beyond, the value of the "
    "nearest end"
)


def line_weights(rows: tuple[float, float], count: int, row: ArrayLike) -> Floats:
    """[..., count]: weights of the coefficients at lines ``row`` of the domain ``rows``, px."""
    row = np.asarray(row, dtype=np.float64)
    s = np.clip((row - rows[0]) / (rows[1] - rows[0]), 0.0, 1.0) * (count - 3)
    first = np.minimum(np.floor(s).astype(np.int64), count - 4)
    dense = np.zeros((*row.shape, count))
    for a, weight in enumerate(cubic_weights(s - first)):
        np.put_along_axis(dense, (first + a)[..., None], weight[..., None], axis=-1)
    return dense


@dataclass(frozen=True, eq=False)
class LineCorrection:
    """See MEANING: ``rows`` (row_min, row_max) px; ``coefficients`` float64[2, n] px of C and R.

    Raises ValueError unless they are finite and there are four of each or more.
    """

    rows: tuple[float, float]
    coefficients: Floats

    def __post_init__(self) -> None:
        values = np.array(self.coefficients, dtype=np.float64)
        if values.ndim != 2 or len(values) != 2 or values.shape[1] < 4:
            raise ValueError("a correction by line has two splines of four coefficients or more")
        if not np.isfinite([*self.rows, *values.ravel()]).all() or self.rows[0] >= self.rows[1]:
            raise ValueError("a correction by line must be finite, and have lines")
        values.setflags(write=False)
        object.__setattr__(self, "coefficients", values)

    def at(self, row: ArrayLike) -> Floats:
        """(C, R) [2, ...] px at lines ``row`` of the smooth sensor."""
        weights = line_weights(self.rows, self.coefficients.shape[1], np.nan_to_num(row))
        found = np.moveaxis(weights @ self.coefficients.T, -1, 0)
        return np.where(np.isfinite(row), found, np.nan)

    def add(self, col: Floats, row: Floats) -> tuple[Floats, Floats]:
        """Position in the image of a position (col, row) of the smooth sensor, px."""
        along, across = self.at(row)
        return col + along, row + across

    def take(self, col: ArrayLike, row: ArrayLike) -> tuple[Floats, Floats]:
        """The inverse of :meth:`add`; arrays broadcast."""
        col, row = np.broadcast_arrays(np.asarray(col, float), np.asarray(row, float))
        smooth = row
        for _ in range(ROUNDS):
            last, smooth = smooth, row - self.at(smooth)[1]
            if not np.nanmax(np.abs(smooth - last), initial=0.0) > 1e-10:
                break
        return col - self.at(smooth)[0], smooth

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, in the words of MEANING."""
        return {
            "row_min": self.rows[0],
            "row_max": self.rows[1],
            "col": self.coefficients[0].tolist(),
            "row": self.coefficients[1].tolist(),
            "meaning": MEANING,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> LineCorrection:
        """The inverse of :meth:`to_dict`."""
        rows = float(values["row_min"]), float(values["row_max"])
        return cls(rows, np.array([values["col"], values["row"]], dtype=np.float64))


def read_correction(values: Mapping[str, Any]) -> LineCorrection | None:
    """The correction of a record of :func:`of_record`; None if it has none."""
    return LineCorrection.from_dict(values["by_line"]) if "by_line" in values else None


def of_record(by_line: LineCorrection | None) -> dict[str, Any]:
    """What a record has of a correction: nothing without one."""
    return {} if by_line is None else {"by_line": by_line.to_dict()}
