"""All figures of one pair."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit.label_checks import AS_STATED
from stereobench.audit.matches import match_pair
from stereobench.audit.pair import _to_rows, estimate, measure_arrays

from ...synthetic.pair_with_block import make


@pytest.mark.parametrize("shift, tilt, offset", [((0, 1), 0, 2), ((0.5, 0), 0.8, 0)])
def test_figures_of_a_pair(shift, tilt, offset):
    scene = make(15, shift=shift, tilt=tilt)
    matches = match_pair(scene.left, scene.right, 48)
    labels = scene.labels + np.float32(offset)
    found = measure_arrays(scene.left, scene.right, labels, matches)
    for names, true in (
        (("rows", "parallax"), shift[1]),
        (("rows", "tilt_x"), tilt),
        (("rows", "tilt_y"), 0),
        (("bias", "bias"), offset + shift[0]),
        (("contradicted", "share"), 0),
    ):
        got = estimate(found, *names)
        low, high = got.interval(1e-3)
        assert low - 0.015 <= true <= high + 0.015, names
        assert got.error < 0.06, names
    assert found["hidden"]["share"] == 0
    assert found["convention"]["taken"] == AS_STATED


def test_rows_are_brought_to_the_left_ones_without_bending_a_ramp():
    plane = 0.37, 0.004, -0.003  # px lower: at column and row 0, by column, by row
    y, x = np.mgrid[:80, :120].astype(float)
    right = (100 + 3 * y + 0.5 * x).astype(np.float32)
    found = _to_rows(right, plane)
    lower = plane[0] + plane[1] * x + plane[2] * y
    inner = np.s_[3:-4]
    assert np.abs(found - (right + 3 * lower))[inner].max() < 1e-4
    assert (_to_rows(right, (0.0, 0.0, 0.0)) == right).all()
