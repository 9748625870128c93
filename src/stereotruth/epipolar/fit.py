"""Epipolar geometry of a whole scene as one smooth, invertible model.

A pushbroom pair has no single epipolar line per point, but over the height range of a scene its
epipolar curves pair up so well that two smooth functions describe them: the epipolar row y as a
function of the left image's (col, row) and as a function of the right image's. They are uniform
bicubic B-splines on top of an affine part, fitted by least squares so that virtual ground points,
projected by both sensor models, get equal rows. No image content is used. A correction by line
is no part of the functions: they map the smooth sensors' positions (:mod:`.line_correction`).

- Left: the affine part is a rotation (no mirroring), x is linear along the epipolar direction in
  left px, and d = x_left - x_right increases with height.
- Right: x is fitted to the left's x on the surface of the reference height, so that
  d ≈ k (height - reference height).
- Any common monotone change of the row leaves the rows equal; of all solutions the one nearest to
  the left image's own rotated row is taken (a weak ridge), which keeps pixels nearly square.

Epipolar coordinates (x, y) are pixel coordinates of both rectified images, (0, 0) being the centre
of the upper-left pixel.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..sensor.pair_geometry import convergence_angle, find_overlap, find_rotation, view_order
from ..sensor.rpc import SensorModel
from ..sensor.virtual_points import Points, box_defect, common_box, frame, of_box, of_frames, steps
from .model import EpipolarModel, ImageModel
from .spline_fit import grow, y_parallax
from .spline_kernels import forward_with_slopes

log = logging.getLogger("stereotruth")
Floats = NDArray[np.float64]


ACCEPTED_RMS = 0.01  # px; above this over the RPCs' ground box the domain is narrowed


def _grid(
    left: ImageModel,
    right: ImageModel,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    points: Points,
    names: tuple[str, str],
) -> tuple[int, int, tuple[int, int], tuple[float, float]]:
    """Origin (x0, y0), shape (rows, cols) of the common grid, and the disparity range in px.

    The grid covers what the left frame shares with the right one, moved by any disparity of the
    height range (bounding boxes in epipolar coordinates).
    """
    d = left.forward(*points.left)[0] - right.forward(*points.right)[0]
    bounds = []
    for model, size in zip((left, right), sizes):
        col, row = frame(size, 129)
        bounds.append(np.array(model.forward(col, row)))
    (xl, yl), (xr, yr) = bounds
    x0 = int(np.floor(max(xl.min(), xr.min() + d.min())))
    x1 = int(np.ceil(min(xl.max(), xr.max() + d.max())))
    y0 = int(np.floor(max(yl.min(), yr.min())))
    y1 = int(np.ceil(min(yl.max(), yr.max())))
    if x1 <= x0 or y1 <= y0:
        raise InputError(
            f"left and right image share no epipolar row (other image: {names[1]})",
            file=names[0],
            remedy="check that both images are of one pair and that each RPC belongs to its image",
        )
    return x0, y0, (y1 - y0 + 1, x1 - x0 + 1), (float(d.min()), float(d.max()))


def _figures(parallax: Floats) -> dict[str, Any]:
    return {
        "rms_px": round(float(np.sqrt(np.mean(parallax**2))), 6),
        "max_px": round(float(np.abs(parallax).max()), 6),
        "points": int(parallax.size),
    }


def _scales(model: ImageModel, size: tuple[int, int], name: str) -> list[float]:
    """Smallest and largest scale (epipolar px per image px) of a model over an image's frame."""
    slopes = np.array(
        [forward_with_slopes(model.packed, c, r)[2:] for c, r in zip(*frame(size, 17))]
    ).reshape(-1, 2, 2)
    determinants = np.linalg.det(slopes)
    if determinants.min() * determinants.max() <= 0:
        raise InputError(
            "the epipolar model cannot be inverted over the image",
            file=name,
            remedy="check that the RPC belongs to this image",
        )
    values = np.linalg.svd(slopes, compute_uv=False)
    return [round(float(values.min()), 6), round(float(values.max()), 6)]


def _report(
    left: ImageModel,
    right: ImageModel,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    names: tuple[str, str],
    in_frames: Points,
    in_box: Points | None,
) -> dict[str, Any]:
    """Quality of the image models on points that did not make the fit."""
    return {
        "y_parallax_over_fit_box": (
            None if in_box is None else _figures(y_parallax(left, right, in_box))
        ),
        "y_parallax_over_image_footprints": _figures(y_parallax(left, right, in_frames)),
        "scale_left": _scales(left, sizes[0], names[0]),
        "scale_right": _scales(right, sizes[1], names[1]),
    }


def _px_per_m(left: ImageModel, right: ImageModel, points: Points, reference: float) -> list[float]:
    """Mean, smallest and largest ratio of disparity to height above the reference, px per m."""
    rise = points.ground[2] - reference
    far = np.abs(rise) > 5.0
    d = left.forward(*points.left)[0] - right.forward(*points.right)[0]
    ratio = (d / np.where(far, rise, 1.0))[far]
    return [round(float(v), 6) for v in (ratio.mean(), ratio.min(), ratio.max())]


def fit_epipolar(
    left: SensorModel,
    right: SensorModel,
    left_size: tuple[int, int],
    right_size: tuple[int, int],
    reference_height: float,
    *,
    height_range: tuple[float, float] | None = None,
    names: tuple[str, str] = ("left image", "right image"),
) -> EpipolarModel:
    """Fit the epipolar model of a pair; sizes are (cols, rows) px, heights ellipsoidal m.

    ``height_range`` defaults to what both RPCs cover. Virtual points fill the RPCs' common ground
    box and the frames of both images; if the box cannot be used (see the report), the frames only.
    ``names`` of the images are for messages.

    Raises InputError if the images do not overlap or see the ground from one direction.
    """
    sizes = (left_size, right_size)
    sensors, left, right = (left, right), left.smooth, right.smooth
    box, rpc_heights = common_box(left, right)
    low, high = height_range or rpc_heights
    low, high = min(low, reference_height - 10.0), max(high, reference_height + 10.0)
    overlap = find_overlap(left, right, sizes, reference_height, (low, high), names)
    convergence = convergence_angle(left, right, overlap, reference_height, names)
    rotation, angle = find_rotation(left, right, overlap, reference_height)

    heights, check_heights = steps(low, high, 7, 0.0), steps(low, high, 6, 0.07)
    at_reference = np.array([reference_height])
    in_frames = of_frames(left, right, sizes, heights, 11)
    check_frames = of_frames(left, right, sizes, check_heights, 14)
    surface = of_frames(left, right, sizes, at_reference, 25)
    in_box = of_box(left, right, box, heights, 25, 0.0)
    check_box = of_box(left, right, box, check_heights, 24, 0.02)
    defect = box_defect(left, right, box, in_box, 25 * 25 * heights.size)
    if not defect:
        wide = surface + of_box(left, right, box, at_reference, 25, 0.0)
        images, rms = grow(in_box + in_frames, [check_box, check_frames], wide, rotation)
        if rms > ACCEPTED_RMS:
            defect = f"y-parallax of {rms:.3f} px rms where the RPCs are valid"
    if defect:
        log.warning("epipolar model: %s; fitted to the image footprints only", defect)
        images, rms = grow(in_frames, [check_frames], surface, rotation)
        if rms > ACCEPTED_RMS:
            log.warning("epipolar model: %.3f px rms remain even so", rms)

    x0, y0, shape, disparities = _grid(*images, sizes, in_frames, names)
    images = images[0].shifted(x0, y0), images[1].shifted(x0, y0)
    report = _report(*images, sizes, names, check_frames, None if defect else check_box)
    ratio = _px_per_m(*images, check_frames, reference_height)
    report |= {
        "fit_domain": "image footprints" if defect else "RPC ground box and image footprints",
        "fit_domain_reason": defect or "the ground box is usable",
        "coefficients_per_axis": len(images[0].y_spline),
        "convergence_angle_deg": round(convergence, 4),
        "epipolar_angle_deg": angle,
        "epipolar_angle_meaning": "direction of +x in the left image, from +col towards +row",
        "disparity_px_per_m": dict(zip(("mean", "min", "max"), ratio)),
        "disparity_range_px": [round(d, 2) for d in disparities],
        "view_order": view_order(left, right, overlap, reference_height),
    }
    reach = in_frames if defect else in_frames + in_box
    low_high = np.concatenate([reach.ground[:2].min(axis=1), reach.ground[:2].max(axis=1)])
    model = EpipolarModel(
        left=sensors[0],
        right=sensors[1],
        left_image=replace(images[0], by_line=sensors[0].by_line),
        right_image=replace(images[1], by_line=sensors[1].by_line),
        shape=shape,
        left_size=left_size,
        right_size=right_size,
        reference_height=float(reference_height),
        height_range=(float(low), float(high)),
        ground_box=tuple(float(v) for v in low_high),
        report=report,
    )
    log.info(
        "epipolar model: y-parallax %.4f px rms, %.4f px at most over the footprints; convergence "
        "%.2f degrees; disparity %.3f px per m; grid of %d x %d px (%s)",
        report["y_parallax_over_image_footprints"]["rms_px"],
        report["y_parallax_over_image_footprints"]["max_px"],
        convergence,
        ratio[0],
        *shape,
        report["view_order"],
    )
    return model
