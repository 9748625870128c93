"""What the uncertainty of an alignment means for labels: of their disparity, and of their place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..epipolar.model import EpipolarModel

Floats = NDArray[np.float64]
LabelSigma = Callable[[EpipolarModel, Any, Any], tuple[Floats, Floats, Floats]]


SIGMA_STEP = 512  # px between the nodes of the alignment's uncertainty


def sigma_nodes(model: EpipolarModel, sigma: LabelSigma) -> dict[str, Any]:
    """Uncertainty of labels by the alignment at nodes of the epipolar grid, JSON-ready.

    ``step_px`` between nodes; ``disparity``, ``x``, ``y`` [row][col] in px, node (0, 0) at the
    centre of the upper-left pixel, the last ones at or past the grid's end.
    """
    rows, cols = (SIGMA_STEP * np.arange(-(-(n - 1) // SIGMA_STEP) + 1) for n in model.shape)
    values = sigma(model, cols[None, :], rows[:, None])
    nodes = {}
    for name, value in zip(("disparity", "x", "y"), values):
        worst = float(np.nanmax(value)) if np.isfinite(value).any() else 0.0
        nodes[name] = np.where(np.isfinite(value), value, worst).round(5).tolist()
    return {"step_px": SIGMA_STEP, **nodes}


@dataclass(frozen=True, eq=False)
class LabelUncertainty:
    """Standard uncertainty (px) that the alignment gives to labels, on nodes over the left grid.

    ``nodes`` [3, rows, cols]: of the disparity, and of the label's place along x and y; ``step`` px
    between nodes, the first at pixel (0, 0).
    """

    nodes: Floats
    step: float

    @classmethod
    def of(cls, attrs: Mapping[str, Any]) -> LabelUncertainty:
        """From the attributes of the rectified left image; zero where they do not tell."""
        known = attrs.get("alignment_sigma")
        if known is None:
            return cls(np.zeros((3, 1, 1)), 1.0)
        nodes = np.array([known[name] for name in ("disparity", "x", "y")], dtype=np.float64)
        return cls(np.nan_to_num(nodes, nan=float(np.nanmax(nodes, initial=0.0))), known["step_px"])

    def at(self, x: Floats, y: Floats) -> Floats:
        """[3, rows, cols] at columns ``x`` and rows ``y``, bilinear between the nodes."""
        rows, cols = self.nodes.shape[1:]
        out = np.empty((3, y.size, x.size))
        v, u = np.clip(y / self.step, 0, rows - 1), np.clip(x / self.step, 0, cols - 1)
        _bilinear(self.nodes, v, u, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _bilinear(nodes: Floats, v: Floats, u: Floats, out: Floats) -> None:
    """``out`` [k, v.size, u.size]: values between ``nodes`` [k, rows, cols]."""
    last_row, last_col = nodes.shape[1] - 1, nodes.shape[2] - 1
    for k in range(nodes.shape[0]):
        for y in range(v.size):
            j = min(int(v[y]), max(last_row - 1, 0))
            below, f = min(j + 1, last_row), v[y] - j
            for x in range(u.size):
                i = min(int(u[x]), max(last_col - 1, 0))
                beside, e = min(i + 1, last_col), u[x] - i
                upper = (1.0 - e) * nodes[k, j, i] + e * nodes[k, j, beside]
                lower = (1.0 - e) * nodes[k, below, i] + e * nodes[k, below, beside]
                out[k, y, x] = (1.0 - f) * upper + f * lower
