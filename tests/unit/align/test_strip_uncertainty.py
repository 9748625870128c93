"""What strips of the LiDAR that disagree add to the uncertainty of labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.align.label_uncertainty import SQUARE_DEG, STEP, LabelUncertainty, with_strips
from stereotruth.core.numerics.degrees import exact_metres_per_degree
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.lidar.point_store import SQUARES
from stereotruth.lidar.strip_offsets import SHARE, Strip, StripKey, StripOffsets

from ...synthetic.cameras import HEIGHT
from ...synthetic.textured_pair import NONE, SIZE, start

OFFSET = np.array([0.3, -0.2, 0.12])
ZERO = ((0.0,) * 3,) * 3


@pytest.fixture(scope="module")
def model():
    planted = start(NONE, NONE, 0.1)
    return fit_epipolar(planted.left, planted.right, SIZE, SIZE, HEIGHT)


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
        sigma = np.sqrt(found.variance(cols, rows, slope)).reshape(-1)
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
