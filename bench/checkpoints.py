"""Disparities at check points: points measured in both images that took no part in anything.

The disparity measured at a check point is x_left − x_right of its two measured image positions,
mapped by the epipolar model. The label there is taken at the sub-pixel position in the rectified
left image: bilinearly from those of the four neighbours that are labelled (weights renormalised),
if the nearest is; from the nearest alone if the labels differ by more than ``STEP_PX``, as at an
edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.alignment.control_points import ControlPoints, read_gcps
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.numerics.error_sums import LIMITS
from stereotruth.numerics.robust import median_and_nmad
from stereotruth.products.grids import blocks, require_complete

Floats = NDArray[np.float64]


STEP_PX = 1.0  # px of disparity between four neighbours: beyond, they are not one surface


@dataclass(frozen=True, eq=False)
class CheckPointErrors:
    """n check points that both images see.

    ``x``, ``y`` px in the left epipolar grid, ``measured`` and ``label`` disparity in px (NaN
    where there is no label), ``inner`` bool[n]: four labelled neighbours of one surface;
    ``y_parallax`` px, y_right − y_left of the measured positions.
    """

    ids: tuple[str, ...]
    x: Floats
    y: Floats
    measured: Floats
    label: Floats
    inner: NDArray[np.bool_]
    y_parallax: Floats

    def figures(self) -> dict[str, Any]:
        """JSON-ready: px, of label less measured disparity, and of the y-parallax.

        ``inner``: of the points on one surface. A check point on the corner of a roof has ground
        for most of its neighbours, and which of them it stands for is not known.
        """
        labelled = np.isfinite(self.label)
        errors = (self.label - self.measured)[labelled]
        result: dict[str, Any] = {
            "points": len(self.ids),
            "labelled": int(labelled.sum()),
            "y_parallax_rms": None,
            "y_parallax_median": None,
        }
        result |= _spread(errors)
        result["inner"] = _spread((self.label - self.measured)[labelled & self.inner])
        if self.ids:
            result["y_parallax_rms"] = float(np.sqrt(np.mean(self.y_parallax**2)))
            result["y_parallax_median"] = float(np.median(self.y_parallax))
        return {k: round(v, 6) if isinstance(v, float) else v for k, v in result.items()}


def _spread(errors: Floats) -> dict[str, Any]:
    if not errors.size:
        return {"count": 0, "median": None, "nmad": None, "mean_absolute": None}
    median, nmad = median_and_nmad(errors)
    size = np.abs(errors)
    values = {"median": median, "nmad": nmad, "mean_absolute": float(size.mean())}
    values |= {f"share_over_{limit:g}_px": float((size > limit).mean()) for limit in LIMITS}
    return {"count": errors.size, **{key: round(value, 6) for key, value in values.items()}}


def sample_labels(disparity: Any, x: Floats, y: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Labels float64[n] px at sub-pixel positions of a grid [y, x]; NaN where there is none.

    The second is bool[n]: all four neighbours are labelled, as one surface. ``disparity`` may be
    a Zarr array; it is read in blocks.
    """
    height, width = disparity.shape
    label, inner = np.full(x.shape, np.nan), np.zeros(x.shape, dtype=bool)
    # Every point belongs to the block of its upper-left neighbour.
    i = np.clip(np.floor(x), 0, width - 2)
    j = np.clip(np.floor(y), 0, height - 2)
    inside = (np.abs(x - (width - 1) / 2) <= width / 2) & (
        np.abs(y - (height - 1) / 2) <= height / 2
    )
    for rows, cols in blocks((height, width), 1024):
        at = np.flatnonzero(
            inside & (j >= rows.start) & (j < rows.stop) & (i >= cols.start) & (i < cols.stop)
        )
        if not at.size:
            continue
        part = np.asarray(disparity[rows.start : rows.stop + 1, cols.start : cols.stop + 1], float)
        jj, ii = (j[at] - rows.start).astype(int), (i[at] - cols.start).astype(int)
        four = np.stack(
            [part[jj, ii], part[jj, ii + 1], part[jj + 1, ii], part[jj + 1, ii + 1]], axis=1
        )
        fy, fx = np.clip(y[at] - j[at], 0, 1), np.clip(x[at] - i[at], 0, 1)  # half a pixel outside
        weights = np.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx], axis=1)
        nearest = np.argmax(weights, axis=1)
        there = four[np.arange(at.size), nearest]
        known = np.isfinite(four)
        weights = np.where(known, weights, 0.0)
        low, high = (f(np.where(known, four, there[:, None]), axis=1) for f in (np.min, np.max))
        with np.errstate(invalid="ignore"):
            mean = (weights * np.where(known, four, 0.0)).sum(axis=1) / weights.sum(axis=1)
            one_surface = high - low <= STEP_PX
        label[at] = np.where(np.isfinite(there), np.where(one_surface, mean, there), np.nan)
        inner[at] = known.all(axis=1) & one_surface
    return label, inner


def check_point_errors(
    model: EpipolarModel, disparity: Any, points: ControlPoints
) -> CheckPointErrors:
    """Labels of a disparity grid [y, x] against the check points that both images see."""
    both = np.flatnonzero(points.in_left & points.in_right)
    x, y = model.left_to_epipolar(*points.left[both].T)
    x_right, y_right = model.right_to_epipolar(*points.right[both].T)
    label, inner = sample_labels(disparity, x, y)
    return CheckPointErrors(
        ids=tuple(points.ids[i] for i in both),
        x=x,
        y=y,
        measured=x - x_right,
        label=label,
        inner=inner,
        y_parallax=y_right - y,
    )


def evaluate_checkpoints(
    disparity: str | Path, checkpoints_csv: str | Path, *, scene: str = ""
) -> Mapping[str, Any]:
    """Figures of a scene's disparity.zarr at the check points of a CSV file (that of GCPs).

    Raises InputError for an unfinished store or a faulty file.
    """
    store = require_complete(disparity)
    model = EpipolarModel.from_dict(store.attrs["epipolar"])
    points = read_gcps(checkpoints_csv, scene)
    return check_point_errors(model, store["disparity"], points).figures()
