"""Labels that the images contradict."""

from __future__ import annotations

import numpy as np

from stereobench.audit.contradiction import scan_labels
from stereobench.audit.matches import grey, smooth

from ...synthetic.pair_with_block import BLOCK, HEIGHT_PX, make


def test_right_labels_are_not_contradicted_wrong_ones_are():
    scene = make(9)
    left, right = smooth(grey(scene.left)), smooth(grey(scene.right))
    good = scan_labels(left, right, scene.labels, (-20.0, 30.0))
    assert good.x.size > 500
    assert good.beaten.mean() < 0.005
    wrong = scene.labels.copy()
    wrong[200:280, 20:120] += 7
    scan = scan_labels(left, right, wrong, (-20.0, 30.0))
    inside = (scan.x > 26) & (scan.x < 112) & (scan.y > 206) & (scan.y < 274)
    assert scan.beaten[inside].mean() > 0.8
    assert np.all(np.abs(scan.shift[inside & scan.beaten] + 7) <= 1)
    assert scan.beaten[~inside].mean() < 0.03
    share = scan.contradicted()
    assert share.value > 0.4 * inside.mean()


def test_a_removed_block_is_contradicted():
    scene = make(10)
    labels = scene.labels.copy()
    first, last, top, bottom = BLOCK
    labels[top:bottom, first:last] -= np.float32(HEIGHT_PX)
    scan = scan_labels(smooth(grey(scene.left)), smooth(grey(scene.right)), labels, (-20.0, 30.0))
    inside = (scan.x >= first) & (scan.x < last) & (scan.y >= top) & (scan.y < bottom)
    assert scan.beaten[inside].mean() > 0.7
    assert scan.beaten[~inside].mean() < 0.01


def test_noise_contradicts_nothing():
    """Where the images show no common thing, chance wins here as often as in the decoy."""
    rng = np.random.default_rng(11)
    left, right = (smooth(rng.normal(size=(384, 384)).astype(np.float32)) for _ in "lr")
    scan = scan_labels(left, right, np.zeros((384, 384), np.float32), (-60.0, 60.0))
    share = scan.contradicted()
    assert scan.x.size > 500
    assert abs(share.value) <= max(4 * share.error, 0.01)
