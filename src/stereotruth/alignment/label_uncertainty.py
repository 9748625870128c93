"""What the uncertainty of an alignment means for labels: of their disparity, and of their place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..epipolar.model import EpipolarModel
from ..kernels import kernel
from .aligned_pair import Alignment

Floats = NDArray[np.float64]


STEP = 512  # px between the nodes
ATTRIBUTE = "alignment_sigma"  # of the rectified left image
_NAMES = ("disparity", "x", "y")


def label_sigma(
    alignment: Alignment, model: EpipolarModel, x: ArrayLike, y: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Standard uncertainty in px that an alignment gives to labels at epipolar (x, y).

    Of the disparity, and of the label's own x and y in the left grid. For points at the
    reference height; NaN where the model has no ground.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    height = model.reference_height
    left = np.stack(model.epipolar_to_left(x, y), axis=-1)
    ground = model.left.localize(left[..., 0], left[..., 1], height)
    right = np.stack(model.right.project(*ground, height), axis=-1)
    effects = [
        image.slopes(at[..., 0], at[..., 1]) @ fit.design(at[..., 0], at[..., 1])
        for image, at, fit in zip(
            (model.left_image, model.right_image), (left, right), alignment.fits
        )
    ]
    disparity = np.concatenate([effects[0][..., 0, :], -effects[1][..., 0, :]], axis=-1)
    of_left = alignment.left_fit.covariance
    variances = [np.einsum("...i,ij,...j->...", disparity, alignment.covariance, disparity)]
    for axis in (0, 1):
        e = effects[0][..., axis, :]
        variances.append(np.einsum("...i,ij,...j->...", e, of_left, e))
    return tuple(np.sqrt(np.maximum(v, 0.0)) for v in variances)


@dataclass(frozen=True, eq=False)
class LabelUncertainty:
    """Standard uncertainty (px) that the alignment gives to labels, on nodes over the left grid.

    ``nodes`` [3, rows, cols]: of the disparity, and of the label's place along x and y; ``step`` px
    between nodes, node (0, 0) at the centre of the upper-left pixel.
    """

    nodes: Floats
    step: int

    @classmethod
    def of(cls, alignment: Alignment, model: EpipolarModel) -> LabelUncertainty:
        """Of a pair's alignment, to 1e-5 px; the last nodes lie at or past the grid's end.

        Where the model has no ground, the greatest value is taken.
        """
        rows, cols = (STEP * np.arange(-(-(n - 1) // STEP) + 1) for n in model.shape)
        nodes = []
        for value in label_sigma(alignment, model, cols[None, :], rows[:, None]):
            worst = float(np.nanmax(value)) if np.isfinite(value).any() else 0.0
            nodes.append(np.where(np.isfinite(value), value, worst).round(5))
        return cls(np.stack(nodes), STEP)

    def to_attrs(self) -> dict[str, Any]:
        """The attribute that tells it, JSON-ready: ``step_px``; by name, nodes [row][col] in px."""
        nodes = {name: values.tolist() for name, values in zip(_NAMES, self.nodes)}
        return {ATTRIBUTE: {"step_px": self.step, **nodes}}

    @classmethod
    def from_attrs(cls, attrs: Mapping[str, Any]) -> LabelUncertainty:
        """From the attributes of the rectified left image; zero where they do not tell."""
        known = attrs.get(ATTRIBUTE)
        if known is None:
            return cls(np.zeros((3, 1, 1)), 1)
        nodes = np.array([known[name] for name in _NAMES], dtype=np.float64)
        return cls(nodes, known["step_px"])

    def at(self, x: Floats, y: Floats) -> Floats:
        """[3, rows, cols] at columns ``x`` and rows ``y``, bilinear between the nodes."""
        rows, cols = self.nodes.shape[1:]
        out = np.empty((3, y.size, x.size))
        v, u = np.clip(y / self.step, 0, rows - 1), np.clip(x / self.step, 0, cols - 1)
        _bilinear(self.nodes, v, u, out)
        return out


@kernel
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
