"""Rays of matching pixels meet on the surface."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from stereotruth.epipolar.intersection import intersect
from stereotruth.epipolar.model import EpipolarModel

from ...synthetic.cameras import HEIGHT, LAT, LON
from ...synthetic.flat_model import disparity_of, make_model, plane


@pytest.fixture(scope="module")
def model() -> EpipolarModel:
    return make_model()


@pytest.fixture(scope="module")
def of_plane(model) -> np.ndarray:
    return disparity_of(model, plane)


def test_intersections_project_back_and_lie_on_the_surface(model, of_plane):
    d = of_plane.copy()
    d[10:14, 20:30] = np.nan
    d[200:, 300:] += 40.0  # a jump
    lon, lat, h = intersect(model, d[5:], row=5)
    assert np.array_equal(np.isfinite(h), np.isfinite(d[5:]))
    y, x = np.mgrid[5 : model.shape[0], : model.shape[1]]
    xl, yl, xr, yr = model.ground_to_epipolar(lon, lat, h).reshape(4, *h.shape)
    known = np.isfinite(h)
    for found, wanted in ((xl, x), (xr, x - d[5:].astype(float)), (yl, y), (yr, y)):
        assert np.abs(found - wanted)[known].max() < 1e-4
    flat = known.copy()
    flat[195:, 300:] = False
    assert np.abs(h - plane(lon, lat))[flat].max() < 1e-4


def test_rays_that_miss_are_brought_together_by_least_squares(model):
    """Against a general solver, at places where the epipolar rows were moved apart."""
    moved = model.right_image.shifted(0.0, -0.7)
    apart = EpipolarModel(**{**vars_of(model), "right_image": moved})
    for row, col, d in ((40, 50, 3.0), (200, 200, -20.0), (300, 120, 60.0)):
        found = intersect(apart, np.full((1, 1), d, np.float32), row, col)[:, 0, 0]
        places = np.array(
            [*model.left_image.inverse(col, row), *moved.inverse(col - d, row)]
        ).ravel()

        def residuals(p, places=places):
            lon, lat = LON + p[0] * 1e-5, LAT + p[1] * 1e-5
            both = [*model.left.project(lon, lat, p[2]), *model.right.project(lon, lat, p[2])]
            return np.array(both).ravel() - places

        best = least_squares(residuals, [0.0, 0.0, HEIGHT], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        wanted = np.array([LON + best.x[0] * 1e-5, LAT + best.x[1] * 1e-5, best.x[2]])
        assert np.abs(best.fun).max() > 0.1
        assert np.abs((found - wanted) * (1e5, 1e5, 1.0)).max() < 2e-3


def vars_of(model: EpipolarModel) -> dict:
    return {name: getattr(model, name) for name in EpipolarModel.__dataclass_fields__}
