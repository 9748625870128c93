"""What the covariance of the alignment means for labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.align.alignment import Alignment
from stereotruth.align.label_uncertainty import (
    STEP,
    LabelUncertainty,
    label_covariance,
    label_sigma,
)
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.cameras import HEIGHT, METRES
from ...synthetic.textured_pair import NONE, SIZE, start

X, Y = np.array([100.0, 350.0, 600.0]), np.array([120.0, 500.0, 300.0])


@pytest.fixture(scope="module")
def root() -> np.ndarray:
    """Of a covariance in which all twelve parameters depend on each other."""
    return np.random.default_rng(0).normal(0, 0.05, (12, 12))


@pytest.fixture(scope="module")
def alignment(root) -> Alignment:
    planted, covariance = start(NONE, NONE, 0.1), root @ root.T
    fits = [
        replace(fit, covariance=covariance[k : k + 6, k : k + 6])
        for fit, k in zip(planted.fits, (0, 6))
    ]
    return replace(
        planted, left_fit=fits[0], right_fit=fits[1], cross_covariance=covariance[:6, 6:]
    )


@pytest.fixture(scope="module")
def model(alignment) -> EpipolarModel:
    return fit_epipolar(alignment.left, alignment.right, SIZE, SIZE, HEIGHT)


@pytest.fixture(scope="module")
def drawn(alignment, root) -> list[tuple[SensorModel, SensorModel]]:
    """Pairs of sensors whose parameters are drawn: their sample covariance is that stated."""
    draws = np.random.default_rng(1).normal(0, 1, (200, 12))
    draws -= draws.mean(axis=0)
    draws = draws @ np.linalg.inv(np.linalg.cholesky(draws.T @ draws / len(draws))).T
    pairs = []
    for p in draws @ root.T:
        fits = zip(alignment.fits, (alignment.left, alignment.right), (p[:6], p[6:]))
        pairs.append(tuple(SensorModel(s.rpc, fit.moved(part)) for fit, s, part in fits))
    return pairs


def predicted(
    model: EpipolarModel, pair: tuple[SensorModel, SensorModel], view: str, ground: tuple
) -> np.ndarray:
    """[3, ...] disparity, x and y in the view's grid where a pair of sensors has ground points."""
    x_left, y_left = model.left_to_epipolar(*pair[0].project(*ground))
    x_right, y_right = model.right_to_epipolar(*pair[1].project(*ground))
    place = (x_left, y_left) if view == "left" else (x_right, y_right)
    return np.stack([x_left - x_right, *place])


@pytest.mark.parametrize("view", ["left", "right"])
def test_covariance_is_that_of_ground_points(alignment, model, drawn, view):
    to_image = model.epipolar_to_left if view == "left" else model.epipolar_to_right
    sensor = model.left if view == "left" else model.right
    ground = *sensor.localize(*to_image(X, Y), HEIGHT), HEIGHT
    errors = np.array([predicted(model, pair, view, ground) for pair in drawn])
    for k, stated in enumerate(label_covariance(alignment, model, X, Y, view)):
        spread = np.cov(errors[:, :, k].T, bias=True)
        assert np.allclose(stated, spread, atol=0.005 * np.trace(spread))
    if view == "left":
        for sigma, spread in zip(label_sigma(alignment, model, X, Y), errors.std(axis=0)):
            assert sigma == pytest.approx(spread, rel=0.005)


@pytest.mark.parametrize("view", ["left", "right"])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.4, 0.0), (-0.5, 0.3), (0.2, -0.6)])
def test_variance_is_that_of_labels_of_a_sloped_plane(alignment, model, drawn, view, tilt):
    """At a fixed pixel: each drawn alignment labels a plane of known points anew.

    ``tilt``: rise of the plane to the east and north.
    """
    uncertainty = LabelUncertainty.of(alignment, model, view)
    to_image = model.epipolar_to_left if view == "left" else model.epipolar_to_right
    sensor = model.left if view == "left" else model.right
    east, north = (d.ravel() for d in np.meshgrid([-3.0, 0.0, 3.0], [-3.0, 0.0, 3.0]))
    differs = 0.0
    for x, y in zip(X, Y):
        lon, lat = sensor.localize(*to_image(x, y), HEIGHT)
        height = HEIGHT + tilt[0] * east + tilt[1] * north
        ground = lon + east / METRES[0], lat + north / METRES[1], height
        labels, slopes = [], []
        for pair in drawn:
            disparity, u, v = predicted(model, pair, view, ground)
            plane = np.column_stack([np.ones_like(u), u - x, v - y])
            label, *slope = np.linalg.lstsq(plane, disparity, rcond=None)[0]
            labels.append(label)
            slopes.append(slope)
        slope = np.mean(slopes, axis=0)
        stated = uncertainty.variance(np.array([x]), np.array([y]), slope.reshape(2, 1, 1))
        assert stated.item() == pytest.approx(np.var(labels), rel=0.02)
        dd, xx, yy = np.diagonal(label_covariance(alignment, model, x, y, view))
        apart = dd + slope[0] ** 2 * xx + slope[1] ** 2 * yy
        differs = max(differs, abs(np.log(apart / np.var(labels))))
    assert differs > 0.05 or tilt == (0.0, 0.0)  # squares of each by itself are no answer


def test_between_nodes_it_is_a_covariance_and_at_most_a_little_too_large(alignment, model):
    uncertainty = LabelUncertainty.of(alignment, model)
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, model.shape[1] - 1, 40), rng.uniform(0, model.shape[0] - 1, 30)
    slope = rng.normal(0, 0.5, (2, y.size, x.size))
    stated = uncertainty.variance(x, y, slope)
    e = np.stack([np.ones(slope.shape[1:]), *-slope], axis=-1)
    exact = label_covariance(alignment, model, x[None, :], y[:, None])
    exact = np.einsum("...i,...ij,...j->...", e, exact, e)
    assert (stated >= 0.999 * exact).all()
    assert (stated <= 1.05 * exact).all()
    assert uncertainty.step == STEP


def test_without_ground_the_worst_place_counts(alignment, model, monkeypatch):
    exact = LabelUncertainty.of(alignment, model).nodes

    def holed(*args):
        found = label_covariance(*args)
        found[0, 0] = np.nan
        return found

    monkeypatch.setattr("stereotruth.align.label_uncertainty.label_covariance", holed)
    nodes = LabelUncertainty.of(alignment, model).nodes
    assert np.array_equal(nodes[:, 1:], exact[:, 1:])
    total = exact[[0, 3, 5]].sum(axis=0)
    total[0, 0] = 0.0
    at = np.unravel_index(total.argmax(), total.shape)
    assert np.array_equal(nodes[:, 0, 0], exact[:, *at])
