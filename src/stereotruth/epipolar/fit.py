"""Epipolar geometry of a whole scene as one smooth, invertible model.
A pushbroom pair has no single epipolar line per point, but over the height range of a scene its
epipolar curves pair up so well that two smooth functions describe them: the epipolar row y as a
function of the left image's (col, row) and as a function of the right image's. They are uniform
bicubic B-splines on top of an affine part, fitted by least squares so that virtual ground points,
projected by both sensor models, get equal rows. No image content is used. A correction by line
is no part of the functions: they map the smooth sensors' positions (:mod:`..sensor.rpc`).

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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..sensor.pair_geometry import (
    convergence_angle,
    find_overlap,
    find_rotation,
    frame,
    steps,
    view_order,
)
from ..sensor.rpc import SensorModel, line_weights
from .model import EpipolarModel, ImageModel, forward_with_slopes

log = logging.getLogger("stereotruth")
Box = tuple[float, float, float, float]  # lon_min, lat_min, lon_max, lat_max, degrees
Sizes = tuple[tuple[int, int], tuple[int, int]]  # (cols, rows) px of left and right image
Models = tuple[ImageModel, ImageModel]  # of left and right image

ACCEPTED_RMS = 0.01  # px; above this over the RPCs' ground box the domain is narrowed
MAX_DOMAIN = 300_000.0  # px; the largest scenes have some 50 000
# Weights of the penalties, per coefficient and relative to the mean squared residual (px²).
# A residual floor of r px can push a free direction by about r / (2 sqrt(ridge)); a real
# coefficient of c px is biased by at most sqrt(ridge) c / 2. The weakest is taken that keeps the
# scale of the rows: the RPCs of small images may cover more metres of height than of ground, and
# the rows would shrink to a tenth, with their residuals.
RIDGES = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
ROW_SCALE = (0.9, 1.1)  # of the left image
SCALE_SAMPLES = 500  # places where it is asked
SMOOTHNESS = 1e-10
SIZES = (6, 8, 10, 12)  # coefficients per axis, tried in turn
GOOD_RMS = 0.003  # px; no larger spline is tried below this


# ------------------------------------------------------------------ virtual ground points


@dataclass(frozen=True)
class Points:
    """Virtual points in both images: ground (lon, lat, height) [3, n] and (col, row) [2, n]."""

    ground: Floats
    left: Floats
    right: Floats

    @classmethod
    def at(
        cls, left: SensorModel, right: SensorModel, lon: Floats, lat: Floats, h: Floats
    ) -> Points:
        """Of ground positions that broadcast; those that no image can have are left out."""
        ground = np.stack([np.ravel(c) for c in np.broadcast_arrays(lon, lat, h)])
        in_left, in_right = np.array(left.project(*ground)), np.array(right.project(*ground))
        good = np.isfinite(np.vstack([ground, in_left, in_right])).all(axis=0)
        return cls(ground[:, good], in_left[:, good], in_right[:, good])

    def __add__(self, other: Points) -> Points:
        return Points(
            np.hstack([self.ground, other.ground]),
            np.hstack([self.left, other.left]),
            np.hstack([self.right, other.right]),
        )


def of_frames(
    left: SensorModel, right: SensorModel, sizes: Sizes, heights: Floats, n: int
) -> Points:
    """Ground points over both images' frames at the given heights."""
    found = []
    for sensor, size in zip((left, right), sizes):
        col, row = frame(size, n)
        lon, lat = sensor.localize(col[:, None], row[:, None], heights[None, :])
        found.append(Points.at(left, right, lon, lat, heights[None, :]))
    return found[0] + found[1]


def of_box(
    left: SensorModel, right: SensorModel, box: Box, heights: Floats, n: int, inset: float
) -> Points:
    """Ground points on a regular grid over a ground box at the given heights."""
    lon, lat, h = np.meshgrid(
        steps(box[0], box[2], n, inset), steps(box[1], box[3], n, inset), heights
    )
    return Points.at(left, right, lon, lat, h)


def common_box(left: SensorModel, right: SensorModel) -> tuple[Box, tuple[float, float]]:
    """Intersection of both RPCs' ground boxes, and height range."""
    a, b = np.array(left.rpc.ground_box), np.array(right.rpc.ground_box)
    b[[0, 2]] += 360.0 * np.round((a[0] + a[2] - b[0] - b[2]) / 720.0)
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:4], b[2:4])
    heights = (max(a[4], b[4]), min(a[5], b[5]))
    if heights[0] >= heights[1]:
        heights = (min(a[4], b[4]), max(a[5], b[5]))
    return tuple(map(float, (*low, *high))), tuple(map(float, heights))


def box_defect(left: SensorModel, right: SensorModel, box: Box, points: Points, n: int) -> str:
    """Why a ground box cannot carry the fit, or an empty string."""
    if box[0] >= box[2] or box[1] >= box[3]:
        return "the RPCs' ground boxes do not overlap"
    if points.ground.shape[1] < n:
        return "the RPCs give no finite image coordinates in parts of their ground box"
    for sensor in (left, right):
        for values in sensor.rpc.denominators(*points.ground):
            if values.min() <= 0.0 <= values.max():
                return "an RPC's denominator vanishes in its ground box"
    for image in (points.left, points.right):
        if np.ptp(image, axis=1).max() > MAX_DOMAIN:
            return f"the RPCs' ground box spans more than {MAX_DOMAIN:.0f} px"
    return ""


# ------------------------------------------------------------------ splines


def _design(domain: Box, n: int, image: Floats) -> Floats:
    """[points, n²] values of the B-splines at image (col, row) [2, points] inside the domain."""
    across, down = (line_weights(domain[k::2], n, image[k]) for k in range(2))
    return (down[:, :, None] * across[:, None, :]).reshape(-1, n * n)


def _second_differences(n: int) -> Floats:
    """[2 n (n - 2), n²]: second differences of n × n coefficients along both axes."""
    one = np.diff(np.eye(n), 2, axis=0)
    return np.vstack([np.kron(np.eye(n), one), np.kron(one, np.eye(n))])


def _domain(image: Floats) -> Box:
    """Bounds of image points, padded by 2 %, in whole px."""
    low, high = image.min(axis=1), image.max(axis=1)
    pad = 0.02 * (high - low) + 2.0
    low, high = np.floor(low - pad), np.ceil(high + pad)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _solve(design: Floats, target: Floats, *penalties: Floats) -> Floats:
    """Least squares with penalty rows; rounded, so that the count of threads leaves no trace."""
    rows = np.vstack([design / np.sqrt(len(target)), *penalties])
    right = np.zeros(len(rows))
    right[: len(target)] = target / np.sqrt(len(target))
    return np.round(np.linalg.lstsq(rows, right, rcond=None)[0], 6)


def _fit_images(points: Points, surface: Points, rotation: Floats, n: int, ridge: float) -> Models:
    """Both image models with n × n coefficients per spline.

    ``points`` make the rows, ``surface`` (at the reference height) the right image's x; ``ridge``
    draws the left rows to those of the ``rotation``.
    """
    homogeneous = np.vstack([surface.right, np.ones(surface.right.shape[1])])
    wanted = rotation @ np.vstack([surface.left, np.ones(surface.left.shape[1])])
    affine = np.linalg.lstsq(homogeneous.T, wanted.T, rcond=None)[0].T
    affine = np.round(affine, 12)
    left_domain = _domain(np.hstack([points.left, surface.left]))
    right_domain = _domain(np.hstack([points.right, surface.right]))

    def rows(matrix: Floats, image: Floats) -> Floats:
        return matrix[:, :2] @ image + matrix[:, 2:]

    left_design = _design(left_domain, n, points.left)
    right_design = _design(right_domain, n, points.right)
    smooth = np.sqrt(SMOOTHNESS / n**2) * _second_differences(n)
    nothing = np.zeros_like(smooth)
    near = np.sqrt(ridge / n**2) * np.eye(n * n)
    y = _solve(
        np.hstack([left_design, -right_design]),
        rows(affine, points.right)[1] - rows(rotation, points.left)[1],
        np.hstack([near, np.zeros_like(near)]),
        np.hstack([smooth, nothing]),
        np.hstack([nothing, smooth]),
    ).reshape(2, n, n)
    x = _solve(
        _design(right_domain, n, surface.right),
        wanted[0] - rows(affine, surface.right)[0],
        smooth * 1e2,
    ).reshape(n, n)
    left = ImageModel(rotation, left_domain, y[0])
    return left, ImageModel(affine, right_domain, y[1], x)


def y_parallax(left: ImageModel, right: ImageModel, points: Points) -> Floats:
    """y_left - y_right in px of virtual points."""
    return left.forward(*points.left)[1] - right.forward(*points.right)[1]


def _slopes(model: ImageModel, col: Floats, row: Floats) -> Floats:
    """[n, 2, 2]: derivatives of (x, y) by (col, row) at image points [n]."""
    found = [forward_with_slopes(model.packed, c, r)[2:] for c, r in zip(col, row)]
    return np.array(found).reshape(-1, 2, 2)


def _fit_at_scale(points: Points, surface: Points, rotation: Floats, n: int) -> Models:
    """Both image models by the weakest of RIDGES that keeps the scale of the left rows."""
    every = max(points.left.shape[1] // SCALE_SAMPLES, 1)
    for ridge in RIDGES:
        models = _fit_images(points, surface, rotation, n, ridge)
        scales = np.linalg.det(_slopes(models[0], *points.left[:, ::every]))
        if ROW_SCALE[0] <= scales.min() and scales.max() <= ROW_SCALE[1]:
            break
    return models


def grow(
    points: Points, checks: list[Points], surface: Points, rotation: Floats
) -> tuple[Models, float]:
    """The smallest spline that is good enough, else the best; with its rms y-parallax in px.

    That is the worst rms of several sets of points that did not make the fit.
    """
    best: Models | None = None
    best_rms = np.inf
    for n in SIZES:
        models = _fit_at_scale(points, surface, rotation, n)
        rms = max(float(np.sqrt(np.mean(y_parallax(*models, check) ** 2))) for check in checks)
        gain = 1.0 - rms / best_rms
        if best is None or gain > 0:
            best, best_rms = models, rms
        if best_rms <= GOOD_RMS or gain < 0.1:
            break
    assert best is not None
    return best, best_rms


# ------------------------------------------------------------------ the model of a pair


def _grid(
    left: ImageModel,
    right: ImageModel,
    sizes: Sizes,
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
    slopes = _slopes(model, *frame(size, 17))
    determinants = np.linalg.det(slopes)
    if determinants.min() * determinants.max() <= 0:
        raise InputError(
            "the epipolar model cannot be inverted over the image",
            file=name,
            remedy="check that the RPC belongs to this image",
        )
    values = np.linalg.svd(slopes, compute_uv=False)
    return [round(float(values.min()), 6), round(float(values.max()), 6)]


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
        images, rms = grow(in_frames, [check_frames], surface, rotation)
        left_over = f", where {rms:.3f} px rms of y-parallax remain" if rms > ACCEPTED_RMS else ""
        log.warning("epipolar model: %s; fitted to the images' footprints%s", defect, left_over)

    x0, y0, shape, disparities = _grid(*images, sizes, in_frames, names)
    images = images[0].shifted(x0, y0), images[1].shifted(x0, y0)
    ratio = _px_per_m(*images, check_frames, reference_height)
    report = {  # on points that did not make the fit
        "y_parallax_over_fit_box": None if defect else _figures(y_parallax(*images, check_box)),
        "y_parallax_over_image_footprints": _figures(y_parallax(*images, check_frames)),
        "scale_left": _scales(images[0], sizes[0], names[0]),
        "scale_right": _scales(images[1], sizes[1], names[1]),
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
