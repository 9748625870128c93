"""All figures of one pair."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import conventions
from stereobench.audit.matches import match_pair
from stereobench.audit.pair import estimate, measure_arrays

from ...synthetic.pair_with_block import make


@pytest.mark.parametrize(
    "shift, tilt, offset", [((0, 0), 0, 0), ((0, 1), 0, 2), ((0.5, 0), 0, 0), ((0, 0), 0.8, 0)]
)
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
    assert found["convention"]["taken"] == conventions.AS_STATED
