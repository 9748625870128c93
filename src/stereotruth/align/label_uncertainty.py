"""What the uncertainty of an alignment means for labels: of their disparity at a fixed pixel.

An alignment that is off moves a label twice. With e_d the error of a ground point's disparity, and
(e_x, e_y) that of its place in the grid of the labelled view, what was at x + e is what the pixel x
is said to show. So the label at a pixel is off by

    e_d - s_x e_x - s_y e_y,

s being the slope of the disparity along x and y. The errors have causes in common: the labelled
image's correction moves place and disparity alike. Its variance therefore needs the covariance of
all three, not their standard deviations alone.

The epipolar grids are made from the same corrections. So a ground point whose rows the alignment
gets wrong in the right image only keeps its left pixel and its disparity: its label is right, and
the right image shows it in another row. That is y-parallax, an error of the images and not of the
labels; e_y is that of the labelled view alone.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.kernels import inner, kernel
from ..core.numerics.interpolation import between_four
from ..epipolar.model import EpipolarModel
from .aligned_pair import Alignment

Floats = NDArray[np.float64]


STEP = 64  # px between the nodes; variances are quadratic in between, and at most too large there
_UPPER = np.triu_indices(3)  # (d, d), (d, x), (d, y), (x, x), (x, y), (y, y)


def label_covariance(
    alignment: Alignment, model: EpipolarModel, x: ArrayLike, y: ArrayLike, view: str = "left"
) -> Floats:
    """Covariance [..., 3, 3] in px² that an alignment gives to labels at (x, y) of a view's grid.

    Of the errors of a ground point's disparity, and of its x and y in the grid of the ``view``,
    left or right. For points at the reference height; NaN where the model has no ground.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    height = model.reference_height
    if view == "left":
        left = np.stack(model.epipolar_to_left(x, y), axis=-1)
        ground = model.left.localize(left[..., 0], left[..., 1], height)
        right = np.stack(model.right.project(*ground, height), axis=-1)
    else:
        right = np.stack(model.epipolar_to_right(x, y), axis=-1)
        ground = model.right.localize(right[..., 0], right[..., 1], height)
        left = np.stack(model.left.project(*ground, height), axis=-1)
    slopes = [
        image.slopes(at[..., 0], at[..., 1])
        for image, at in zip((model.left_image, model.right_image), (left, right))
    ]
    of_left, of_right = (
        slope @ fit.design(at[..., 0], at[..., 1])
        for slope, at, fit in zip(slopes, (left, right), alignment.fits)
    )
    effects = np.zeros((*x.shape, 3, 12))  # of the alignment's parameters on (d, x, y)
    effects[..., 0, :6], effects[..., 0, 6:] = of_left[..., 0, :], -of_right[..., 0, :]
    if view == "left":
        effects[..., 1:, :6] = of_left
    else:
        effects[..., 1:, 6:] = of_right
    weighted = np.einsum("...ip,pq->...iq", effects, alignment.covariance)
    found = np.einsum("...iq,...jq->...ij", weighted, effects)
    found[..., 0, 0] += alignment.shared_px**2
    if alignment.lines_covariance is not None:
        found += _of_lines(alignment, left[..., 1], *slopes, view)
    return found


def _of_lines(
    alignment: Alignment, line: Floats, of_left: Floats, of_right: Floats, view: str
) -> Floats:
    """Covariance [..., 3, 3] px² of (d, x, y) by the corrections of both images by line.

    ``line`` [...] px of the left image; ``of_left``, ``of_right`` [..., 2, 2]: change of each
    image's (x, y) with its (col, row).
    """
    nodes = alignment.lines_covariance
    at = line / (alignment.left_fit.size[1] - 1.0) * (len(nodes) - 1)
    at = np.clip(np.nan_to_num(at), 0.0, len(nodes) - 1.0)
    low = np.minimum(at.astype(np.int64), len(nodes) - 2)
    share = (at - low)[..., None, None]
    covariance = (1.0 - share) * nodes[low] + share * nodes[low + 1]
    effects = np.zeros((*line.shape, 3, 4))
    effects[..., 0, :2], effects[..., 0, 2:] = of_left[..., 0, :], -of_right[..., 0, :]
    own = slice(0, 2) if view == "left" else slice(2, 4)
    effects[..., 1:, own] = of_left if view == "left" else of_right
    return effects @ covariance @ np.swapaxes(effects, -1, -2)


def label_sigma(
    alignment: Alignment, model: EpipolarModel, x: ArrayLike, y: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Standard uncertainty (px) of a ground point's disparity, x and y at left epipolar (x, y)."""
    variances = np.diagonal(label_covariance(alignment, model, x, y), axis1=-2, axis2=-1)
    return tuple(np.sqrt(np.maximum(np.moveaxis(variances, -1, 0), 0.0)))


@dataclass(frozen=True, eq=False)
class LabelUncertainty:
    """Covariance (px²) that the alignment gives to labels, on nodes over the grid of a view.

    ``nodes`` [6, rows, cols]: of (d, d), (d, x), (d, y), (x, x), (x, y), (y, y), see
    :func:`label_covariance`; ``step`` px between nodes, node (0, 0) at the centre of the upper-left
    pixel. Between nodes it is bilinear: a mean of covariances with positive weights, and so a
    covariance too.
    """

    nodes: Floats
    step: int

    @classmethod
    def of(cls, alignment: Alignment, model: EpipolarModel, view: str = "left") -> LabelUncertainty:
        """Of a pair's alignment, to 1e-10 px²; the last nodes lie at or past the grid's end.

        Where the model has no ground, that of the worst place is taken.
        """
        rows, cols = (STEP * np.arange(-(-(n - 1) // STEP) + 1) for n in model.shape)
        found = label_covariance(alignment, model, cols[None, :], rows[:, None], view)
        total = np.trace(found, axis1=-2, axis2=-1)
        known = np.isfinite(total)
        worst = np.zeros((3, 3))
        if known.any():
            worst = found[np.unravel_index(np.nanargmax(total), total.shape)]
        found = np.where(known[..., None, None], found, worst)
        return cls(np.moveaxis(found[..., *_UPPER], -1, 0).round(10), STEP)

    @classmethod
    def none(cls) -> LabelUncertainty:
        """Of an alignment that counts as exact."""
        return cls(np.zeros((6, 1, 1)), 1)

    @property
    def content(self) -> str:
        """Digest of its values."""
        values = np.ascontiguousarray(self.nodes, dtype="<f8")
        text = f"{self.step} {values.shape} ".encode()
        return hashlib.sha256(text + values.tobytes()).hexdigest()[:16]

    @property
    def sigma(self) -> dict[str, float]:
        """Standard uncertainty (px) of disparity, x and y: medians over the grid."""
        return {
            name: round(float(np.median(np.sqrt(np.maximum(self.nodes[k], 0.0)))), 4)
            for name, k in (("disparity", 0), ("x", 3), ("y", 5))
        }

    def variance(self, x: Floats, y: Floats, slope: Floats) -> Floats:
        """Variance px² [rows, cols] of labels at columns ``x`` and rows ``y``, centres of pixels.

        ``slope`` [2, rows, cols]: of the disparity along x and y.
        """
        rows, cols = self.nodes.shape[1:]
        v, u = np.clip(y / self.step, 0, rows - 1), np.clip(x / self.step, 0, cols - 1)
        out = np.empty((y.size, x.size))
        _variance(self.nodes, v, u, slope, out)
        return out


@inner
def _variance_of_node(nodes: Floats, row: int, col: int, sx: float, sy: float) -> float:
    """Of e_d - s_x e_x - s_y e_y at a node."""
    dd, dx, dy = nodes[0, row, col], nodes[1, row, col], nodes[2, row, col]
    xx, xy, yy = nodes[3, row, col], nodes[4, row, col], nodes[5, row, col]
    along = sx * (sx * xx - 2.0 * dx) + sy * (sy * yy - 2.0 * dy)
    return dd + along + 2.0 * sx * sy * xy


@kernel
def _variance(nodes: Floats, v: Floats, u: Floats, slope: Floats, out: Floats) -> None:
    """``out`` [v.size, u.size]: of e_d - s_x e_x - s_y e_y, from ``nodes`` [6, rows, cols]."""
    last_row, last_col = nodes.shape[1] - 1, nodes.shape[2] - 1
    for y in range(v.size):
        j = min(int(v[y]), max(last_row - 1, 0))
        below, f = min(j + 1, last_row), v[y] - j
        for x in range(u.size):
            i = min(int(u[x]), max(last_col - 1, 0))
            beside, e = min(i + 1, last_col), u[x] - i
            sx, sy = slope[0, y, x], slope[1, y, x]
            variance = between_four(
                _variance_of_node(nodes, j, i, sx, sy),
                _variance_of_node(nodes, j, beside, sx, sy),
                _variance_of_node(nodes, below, i, sx, sy),
                _variance_of_node(nodes, below, beside, sx, sy),
                e,
                f,
            )
            out[y, x] = max(variance, 0.0)  # nodes are rounded
