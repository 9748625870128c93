"""Polynomials by cubes against the model that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.local_projection import LocalProjection
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.lidar.lattice import CELL_BITS

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, camera

SIZE = (320, 280)
MIDDLE = np.array([round(LON * 1e9), round(LAT * 1e9), round(HEIGHT * 1e4)])


@pytest.fixture(scope="module")
def model() -> EpipolarModel:
    sensors = [camera(tilt, size=SIZE) for tilt in (BACKWARD, FORWARD)]
    return fit_epipolar(*sensors, SIZE, SIZE, HEIGHT, height_range=(HEIGHT - 50, HEIGHT + 100))


def points(n: int) -> np.ndarray:
    """int64[3, n] of lattice points in some cubes around the scene."""
    spread = np.array([2, 2, 1]) << CELL_BITS
    return (MIDDLE + np.random.default_rng(0).integers(-spread, spread, (n, 3))).T.copy()


def exact(model, lattice: np.ndarray) -> np.ndarray:
    return model.ground_to_epipolar(lattice[0] / 1e9, lattice[1] / 1e9, lattice[2] / 1e4)


def test_points_and_means_are_where_the_model_has_them(model) -> None:
    """Within 1e-5 px, in boxes of any size with the same bits."""
    lattice = points(5000)
    local = LocalProjection.of(model, lattice.min(axis=1), lattice.max(axis=1))
    assert local.good.all()
    xy = local.at_points(*lattice)
    assert np.abs(xy - exact(model, lattice)).max() < 1e-5
    few = lattice[:, :7].copy()
    part = LocalProjection.of(model, few.min(axis=1), few.max(axis=1))
    assert np.array_equal(part.at_points(*few), xy[:, :7])

    sums = np.stack([np.full(2500, 2), *(lattice[:, ::2] + lattice[:, 1::2])], axis=1)
    sums[5] = 0
    found = local.at_means(sums)
    expected = exact(model, (lattice[:, ::2] + lattice[:, 1::2]) / 2)
    assert np.isnan(found[:, 5]).all()
    known = sums[:, 0] > 0
    assert np.abs(found - expected)[:, known].max() < 1e-5


@pytest.mark.parametrize("rough", [False, True])
def test_the_rise_is_what_a_metre_of_height_changes(model, rough) -> None:
    model = Rough() if rough else model
    lattice = points(5000)
    lifted = np.random.default_rng(1).random(5000) < 0.4
    local = LocalProjection.of(model, lattice.min(axis=1), lattice.max(axis=1))
    xy, rise = local.with_rise(*lattice, lifted)
    assert np.array_equal(xy, local.at_points(*lattice))
    metre = np.array([[0], [0], [10_000]])
    by_metre = (exact(model, lattice + metre) - exact(model, lattice - metre)) / 2
    assert np.abs(rise[:, lifted] * 10_000 - by_metre[:, lifted]).max() < 1e-4
    assert np.abs(by_metre).max() > 0.3


class Rough:
    """A model with a kink, which no polynomial follows."""

    def ground_to_epipolar(self, lon, lat, height) -> np.ndarray:
        x = 1e6 * np.abs(lon - LON) + 1e5 * (lat - LAT)
        return np.stack([x, 1e5 * (lat - LAT), x - 2.0 * height, 1e5 * (lat - LAT)])


def test_where_no_polynomial_fits_the_model_is_taken() -> None:
    model, lattice = Rough(), points(3000)
    local = LocalProjection.of(model, lattice.min(axis=1), lattice.max(axis=1))
    assert 0 < (~local.good).sum() < local.good.size
    assert np.abs(local.at_points(*lattice) - exact(model, lattice)).max() < 1e-5
    sums = np.vstack([np.ones(3000, np.int64), lattice]).T.copy()
    sums[3] = 0
    known = sums[:, 0] > 0
    found, expected = local.at_means(sums), exact(model, lattice)
    assert np.abs(found - expected)[:, known].max() < 1e-5
    assert np.isnan(found[:, 3]).all()
