"""What the uncertainty of an alignment means for labels: of their disparity at a fixed pixel.

With e_d the error of a ground point's disparity, (e_x, e_y) that of its place in the grid of the
labelled view, and s the slope of the disparity, the label at a pixel is off by e_d - s_x e_x -
s_y e_y. These have causes in common, so that their covariance is kept, on nodes over the grid. Why,
and why errors of the other image's rows have no part: docs/explanation/uncertainty.md.

A strip of the LiDAR that is off by o = (east, north, up) moves its labels by J o, less what the
alignment takes of all strips together (:func:`_taken`).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.kernels import inner, kernel
from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.geometry import exact_metres_per_degree
from ..core.numerics.interpolation import between_four
from ..epipolar.model import EpipolarModel
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, cell_key
from ..lidar.point_store import SQUARES
from ..lidar.strips import StripOffsets
from .alignment import Alignment

STEP = 64  # px between the nodes; variances are quadratic in between, and at most too large there
_UPPER = np.triu_indices(3)  # (d, d), (d, x), (d, y), (x, x), (x, y), (y, y)
SQUARE_DEG = (1 << CELL_BITS) * LATTICE_DEG / SQUARES
MOVE_M = 10.0  # over which J is a difference


def label_covariance(
    alignment: Alignment, model: EpipolarModel, x: ArrayLike, y: ArrayLike, view: str = "left"
) -> Floats:
    """Covariance [..., 3, 3] in px² that an alignment gives to labels at (x, y) of a view's grid.

    Of the errors of a ground point's disparity, and of its x and y in the grid of the ``view``,
    left or right. For points at the reference height; NaN where the model has no ground.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    place, ground = _ground(model, x, y, view)
    other = model.right if view == "left" else model.left
    there = np.stack(other.project(*ground, model.reference_height), axis=-1)
    left, right = (place, there) if view == "left" else (there, place)
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


def with_strips(
    uncertainty: LabelUncertainty,
    strips: StripOffsets,
    model: EpipolarModel,
    view: str = "left",
    shared_px: float = 0.0,
) -> LabelUncertainty:
    """The uncertainty of labels with what the offsets of named strips add to it.

    The same if no strip is named, or if none lies in the pair. Of offsets that are taken out of the
    points, their own uncertainty remains. ``shared_px``: standard deviation of disparity, in
    ``uncertainty``, by errors that near tie points share: as much of it as strips explain counts
    once.
    """
    if not strips.named:
        return uncertainty
    rows, cols = (STEP * np.arange(-(-(n - 1) // STEP) + 1) for n in model.shape)
    x, y = (a.astype(np.float64) for a in np.meshgrid(cols, rows))
    ground = _ground(model, x, y, view)[1]
    shares = _shares(strips, *ground)
    known = shares.sum(axis=0) > 0
    if not known.any():
        return uncertainty
    jacobian = _jacobian(model, *ground, view)
    offsets = np.array([strip.offset_m for strip in strips.strips])
    if strips.taken_out:
        offsets = np.zeros_like(offsets)
    covariance = np.array([strip.covariance_m2 for strip in strips.strips])
    effects = np.einsum("rcij,kj->krci", jacobian, offsets)
    together = np.einsum("krc,krci->rci", shares, np.nan_to_num(effects))
    rest = effects - _taken(together, x, y, known)
    found = np.einsum("krc,krci,krcj->rcij", shares, rest, rest)
    explained = float(np.mean(found[known][:, 0, 0]))
    found += np.einsum("krc,rcia,kab,rcjb->rcij", shares, jacobian, covariance, jacobian)
    found[~known] = found[known].mean(axis=0)
    found[..., 0, 0] -= min(shared_px**2, explained)
    nodes = np.moveaxis(found[..., *_UPPER], -1, 0).round(10)
    return replace(uncertainty, nodes=uncertainty.nodes + nodes, step=STEP)


def _taken(effects: Floats, x: Floats, y: Floats, known: Bools) -> Floats:
    """What an alignment takes of ``effects`` [rows, cols, 3] at places: the affine function that
    fits those of disparity best, and the mean of those of place.

    Corrections of the images are affine, and level ground tells disparity alone.
    """
    taken = np.broadcast_to(effects[known].mean(axis=0), effects.shape).copy()
    design = np.stack([np.ones_like(x), x / x.max(), y / y.max()], axis=-1)
    found = np.linalg.lstsq(design[known], effects[known][:, 0], rcond=None)[0]
    taken[..., 0] = design @ found
    return taken


def _ground(
    model: EpipolarModel, x: Floats, y: Floats, view: str
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Where the image has places of a view's grid [..., 2] px; longitude and latitude (degrees) of
    the ground there, at the reference height."""
    is_left = view == "left"
    place = model.epipolar_to_left(x, y) if is_left else model.epipolar_to_right(x, y)
    sensor = model.left if is_left else model.right
    return np.stack(place, axis=-1), sensor.localize(*place, model.reference_height)


def _shares(strips: StripOffsets, lon: Floats, lat: Floats) -> Floats:
    """Share [strips, rows, cols] of each strip in the points around places, 0 without any.

    Of the 3 by 3 squares of 7 m around each: about as far as between the nodes.
    """
    row, col = (np.floor(np.nan_to_num(v) / SQUARE_DEG).astype(np.int64) for v in (lat, lon))
    counts = np.zeros((len(strips.strips), *lon.shape))
    held = strips.shares
    for number in range(len(strips.strips)):
        own = held[held["strip"] == number]
        keys = cell_key(own["row"], own["col"])
        by_key = np.argsort(keys)
        keys, own = keys[by_key], own[by_key]
        if not keys.size:
            continue
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                r, c = row + down, col + right
                key = cell_key(r // SQUARES, c // SQUARES)
                at = np.minimum(np.searchsorted(keys, key), keys.size - 1)
                found = own["points"][at, r % SQUARES, c % SQUARES]
                counts[number] += np.where(keys[at] == key, found, 0)
    total = counts.sum(axis=0)
    return counts / np.where(total > 0, total, 1.0)


def _jacobian(model: EpipolarModel, lon: Floats, lat: Floats, view: str) -> Floats:
    """Change [rows, cols, 3, 3] of disparity, x and y (px) in a view's grid by a metre to the east,
    to the north and up."""
    height = model.reference_height
    per_degree = exact_metres_per_degree(float(np.nanmean(lat)), height)

    def seen(east: float, north: float, up: float) -> Floats:
        at = lon + east / per_degree[0], lat + north / per_degree[1], height + up
        x_left, y_left, x_right, y_right = model.ground_to_epipolar(
            *(np.broadcast_to(v, lon.shape).reshape(-1) for v in at)
        )
        x, y = (x_left, y_left) if view == "left" else (x_right, y_right)
        return np.stack([x_left - x_right, x, y], axis=-1).reshape(*lon.shape, 3)

    steps = MOVE_M * np.eye(3)
    return np.stack([(seen(*s) - seen(*-s)) / (2 * MOVE_M) for s in steps], axis=-1)
