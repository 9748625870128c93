"""What the covariance of the alignment means for labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.align.alignment import Alignment
from stereotruth.align.label_uncertainty import (
    SQUARE_DEG,
    STEP,
    LabelUncertainty,
    label_covariance,
    with_strips,
)
from stereotruth.core.numerics.geometry import exact_metres_per_degree
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.lidar.point_store import SQUARES
from stereotruth.lidar.strips import SHARE, Strip, StripKey, StripOffsets
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


def as_cut(slope: np.ndarray) -> np.ndarray:
    """Slopes [2, h, w] as a part of a larger window has them."""
    return np.pad(slope, ((0, 0), (0, 1), (0, 0)))[:, :-1]


@pytest.mark.parametrize(("view", "tilt"), [("left", (0.0, 0.0)), ("right", (-0.5, 0.3))])
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
        stated = uncertainty.variance(np.array([x]), np.array([y]), as_cut(slope.reshape(2, 1, 1)))
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
    stated = uncertainty.variance(x, y, as_cut(slope))
    e = np.stack([np.ones(slope.shape[1:]), *-slope], axis=-1)
    exact = label_covariance(alignment, model, x[None, :], y[:, None])
    exact = np.einsum("...i,...ij,...j->...", e, exact, e)
    assert (stated >= 0.999 * exact).all()
    assert (stated <= 1.05 * exact).all()
    assert uncertainty.step == STEP


# ------------------------------------------------------------ strips of the LiDAR that disagree

OFFSET = np.array([0.3, -0.2, 0.12])
ZERO = ((0.0,) * 3,) * 3


def ground(model, x, y):
    return model.left.localize(*model.epipolar_to_left(x, y), model.reference_height)


@pytest.fixture(scope="module")
def strips(model) -> StripOffsets:
    """A strip in the west and one in the east of the pair, which is off."""
    rows, cols = model.shape
    x, y = np.meshgrid(np.linspace(0, cols, 40), np.linspace(0, rows, 40))
    lon, lat = ground(model, x, y)
    side = SQUARE_DEG * SQUARES
    south, west = (int(np.nanmin(v) / side) for v in (lat, lon))
    north, east = (int(np.nanmax(v) / side) for v in (lat, lon))
    held = []
    for row in range(south - 1, north + 2):
        for col in range(west - 1, east + 2):
            at = (col + (np.arange(SQUARES) + 0.5) / SQUARES) * side
            for number, of in ((0, at < np.nanmedian(lon)), (1, at >= np.nanmedian(lon))):
                held.append((row, col, number, np.tile(of * 100, (SQUARES, 1))))
    keys = [StripKey("point_source_id", k, k) for k in (1, 2)]
    return StripOffsets(
        (
            Strip("1", keys[0], 2e4, "1", (0.0, 0.0, 0.0), ZERO, 1.0, False),
            Strip("2", keys[1], 1e4, "1", tuple(OFFSET), ZERO, 0.0, True),
        ),
        np.array(held, SHARE),
    )


def moved(model, x, y, offset):
    """How far a point of the ground at (x, y) that is off comes out off: disparity, x, y (px)."""
    lon, lat = ground(model, x, y)
    east, north = exact_metres_per_degree(float(np.nanmean(lat)), HEIGHT)
    places = [
        model.ground_to_epipolar(
            lon + k * offset[0] / east,
            lat + k * offset[1] / north,
            np.full(np.shape(lon), model.reference_height + k * offset[2]),
        )
        for k in (0, 1)
    ]
    before, after = (np.stack([p[0] - p[2], p[0], p[1]]) for p in places)
    return after - before


def test_labels_of_a_strip_are_off_by_what_affine_corrections_leave(model, strips):
    """Without slope by the error of disparity, on a slope by that of the place besides."""
    found = with_strips(LabelUncertainty.none(), strips, model)
    rows, cols = (STEP * np.arange(-(-(n - 1) // STEP) + 1.0) for n in model.shape)
    x, y = (v.reshape(-1) for v in np.meshgrid(cols, rows))
    lon, _ = ground(model, x, y)
    edge = np.nanmedian(lon)
    errors = np.where(lon >= edge, moved(model, x, y, OFFSET), 0.0)
    errors -= errors.mean(axis=1, keepdims=True)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    errors[0] -= plane @ np.linalg.lstsq(plane, errors[0], rcond=None)[0]
    pure = np.abs(lon - edge) > 3 * SQUARE_DEG
    assert 0.3 < pure.mean() < 1.0
    for sx, sy in ((0.0, 0.0), (0.4, -0.2)):
        slope = np.stack([np.full((rows.size, cols.size), s) for s in (sx, sy)])
        sigma = np.sqrt(found.variance(cols, rows, as_cut(slope))).reshape(-1)
        expected = np.abs(errors[0] - sx * errors[1] - sy * errors[2])
        assert (
            np.abs(sigma - expected)[pure].max() < 0.15 * expected.max()
        )  # nodes at the line are of both


def test_offsets_that_are_taken_out_leave_their_own_uncertainty(model, strips):
    sigma_m = 0.01
    known = tuple(map(tuple, np.diag([0.0, 0.0, sigma_m**2])))
    off = replace(strips.strips[1], covariance_m2=known)
    taken = replace(strips, strips=(strips.strips[0], off), taken_out=True)
    found = with_strips(LabelUncertainty.none(), taken, model)
    x, y = np.array([model.shape[1] / 2.0]), np.array([model.shape[0] / 2.0])
    of_height = abs(moved(model, x, y, [0.0, 0.0, sigma_m])[0, 0])
    assert np.sqrt(found.nodes[0].max()) == pytest.approx(of_height, rel=0.02)
    assert found.nodes[0].min() == pytest.approx(0.0, abs=1e-9)


def test_strips_that_agree_add_nothing(model, strips):
    agreeing = replace(strips, strips=tuple(replace(s, named=False) for s in strips.strips))
    before = LabelUncertainty.none()
    assert with_strips(before, agreeing, model) is before
