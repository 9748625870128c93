"""Least-squares fit of both images' splines to virtual points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.interpolation import cubic_weights
from ..sensor.virtual_points import Points
from .model import ImageModel
from .spline_kernels import forward_with_slopes

Floats = NDArray[np.float64]


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


def _design(domain: tuple[float, float, float, float], n: int, image: Floats) -> Floats:
    """[points, n²] values of the B-splines at image (col, row) [2, points] inside the domain."""
    weights = []
    for axis, coordinate in enumerate(image):
        s = (coordinate - domain[axis]) / (domain[axis + 2] - domain[axis]) * (n - 3)
        i = np.clip(np.floor(s).astype(int), 0, n - 4)
        dense = np.zeros((s.size, n))
        for a, w in enumerate(cubic_weights(s - i)):
            dense[np.arange(s.size), i + a] = w
        weights.append(dense)
    return (weights[1][:, :, None] * weights[0][:, None, :]).reshape(-1, n * n)


def _second_differences(n: int) -> Floats:
    """[2 n (n - 2), n²]: second differences of n × n coefficients along both axes."""
    one = np.diff(np.eye(n), 2, axis=0)
    return np.vstack([np.kron(np.eye(n), one), np.kron(one, np.eye(n))])


def _domain(image: Floats) -> tuple[float, float, float, float]:
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


def _fit_images(
    points: Points, surface: Points, rotation: Floats, n: int, ridge: float
) -> tuple[ImageModel, ImageModel]:
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
    return (
        ImageModel(rotation, left_domain, y[0]),
        ImageModel(affine, right_domain, y[1], x),
    )


def y_parallax(left: ImageModel, right: ImageModel, points: Points) -> Floats:
    """y_left - y_right in px of virtual points."""
    return left.forward(*points.left)[1] - right.forward(*points.right)[1]


def _keeps_row_scale(left: ImageModel, points: Points) -> bool:
    """Whether the left image's rows have about the scale of its pixels all over the points."""
    every = max(points.left.shape[1] // SCALE_SAMPLES, 1)
    slopes = np.array([
        forward_with_slopes(left.packed, col, row)[2:] for col, row in points.left[:, ::every].T
    ]).reshape(-1, 2, 2)  # fmt: skip
    scales = np.linalg.det(slopes)
    return bool(ROW_SCALE[0] <= scales.min() and scales.max() <= ROW_SCALE[1])


def _fit_at_scale(
    points: Points, surface: Points, rotation: Floats, n: int
) -> tuple[ImageModel, ImageModel]:
    """Both image models by the weakest of RIDGES that keeps the scale of the left rows."""
    for ridge in RIDGES:
        models = _fit_images(points, surface, rotation, n, ridge)
        if _keeps_row_scale(models[0], points):
            break
    return models


def grow(
    points: Points, checks: list[Points], surface: Points, rotation: Floats
) -> tuple[tuple[ImageModel, ImageModel], float]:
    """The smallest spline that is good enough, else the best; with its rms y-parallax in px.

    That is the worst rms of several sets of points that did not make the fit.
    """
    best: tuple[ImageModel, ImageModel] | None = None
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
