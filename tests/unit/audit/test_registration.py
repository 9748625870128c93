"""Labels that lie on wrong pixels."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import registration
from stereobench.audit.matches import grey, smooth

from ...synthetic.pair_with_block import make


@pytest.mark.parametrize("move", [(0, 0), (2, 0), (0, -2)])
def test_labels_that_lie_on_wrong_pixels_are_found_beside_steps(move, monkeypatch):
    monkeypatch.setattr(registration, "MIN_PIXELS", 300)
    scene = make(17)
    labels = np.roll(scene.labels, move[::-1], axis=(0, 1))
    pictures = smooth(grey(scene.left)), smooth(grey(scene.right))
    back, gain = registration.better_place(*pictures, labels)
    if move == (0, 0):
        assert gain.value < 0
    else:
        assert back == (-move[0], -move[1])
        assert gain.interval(0.001)[0] > 0.15
