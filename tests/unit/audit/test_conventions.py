"""Signs and nodata values of labels."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import conventions
from stereobench.audit.matches import match_pair

from ...synthetic.pair_with_block import make


@pytest.mark.parametrize(
    "change, expected",
    [
        (lambda s: (s.left, s.right, s.labels), conventions.AS_STATED),
        (lambda s: (s.left, s.right, s.labels + 2), conventions.AS_STATED),
        (lambda s: (s.left, s.right, -s.labels), conventions.SIGN),
        (lambda s: (s.right, s.left, s.labels), conventions.SWAPPED),
        (lambda s: (s.right, s.left, -s.labels), conventions.SWAPPED_SIGN),
    ],
)
def test_convention(change, expected):
    left, right, labels = change(make(12, slope=0.15))
    best, more = conventions.convention(labels, match_pair(left, right, 40))
    assert best == expected
    if expected != conventions.AS_STATED:
        assert more.interval(0.01)[0] > 0


def test_a_flat_tile_does_not_tell_its_sign():
    scene = make(13)
    flat = np.zeros_like(scene.labels)
    best, _ = conventions.convention(flat, match_pair(scene.left, scene.left, 40))
    assert best == conventions.AS_STATED


def test_values_of_a_label_file():
    rng = np.random.default_rng(14)
    labels = rng.normal(0, 5, (200, 200)).astype(np.float32)
    good = conventions.label_values(labels, (-64, 64))
    assert (good.step, good.strays, good.spikes, good.outside) == (None, [], [], 0.0)
    whole = conventions.label_values(np.rint(labels), (-64, 64))
    assert whole.step == 1.0 and not whole.spikes
    holes = labels.copy()
    holes[:50] = 0
    assert conventions.label_values(holes, (-64, 64)).spikes == [(0.0, 0.25)]
    holes[:50] = -9999
    bad = conventions.label_values(holes, (-64, 64))
    steep = np.tile(np.linspace(-90, 0, 200, dtype=np.float32).round(2), (200, 1))
    assert conventions.label_values(steep, (-64, 64)).strays == []
    assert bad.strays == [(-9999.0, 0.25)] and bad.outside == pytest.approx(0.25)
    assert conventions.label_values(np.full((9, 9), np.nan), (-64, 64)).labelled == 0
