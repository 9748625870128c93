"""What labels and images of a pair say of each other, on a scene whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import label_checks
from stereobench.audit.matches import grey, match_pair, smooth

from ...synthetic.pair_with_block import make


def smoothed(scene):
    return smooth(grey(scene.left)), smooth(grey(scene.right))


@pytest.mark.parametrize(
    "change, expected",
    [
        (lambda s: (s.left, s.right, s.labels + 2), label_checks.AS_STATED),
        (lambda s: (s.left, s.right, -s.labels), label_checks.SIGN),
        (lambda s: (s.right, s.left, s.labels), label_checks.SWAPPED),
        (lambda s: (s.right, s.left, -s.labels), label_checks.SWAPPED_SIGN),
    ],
)
def test_what_labels_mean(change, expected):
    left, right, labels = change(make(12, slope=0.15))
    best, more = label_checks.convention(labels, match_pair(left, right, 40))
    assert best == expected
    if expected != label_checks.AS_STATED:
        assert more.interval(0.01)[0] > 0


def test_a_flat_tile_does_not_tell_its_sign():
    scene = make(13)
    flat = np.zeros_like(scene.labels)
    best, _ = label_checks.convention(flat, match_pair(scene.left, scene.left, 40))
    assert best == label_checks.AS_STATED


def test_values_of_a_label_file():
    rng = np.random.default_rng(14)
    labels = rng.normal(0, 5, (200, 200)).astype(np.float32)
    good = label_checks.label_values(labels, (-64, 64))
    assert (good.step, good.strays, good.spikes, good.outside) == (None, [], [], 0.0)
    whole = label_checks.label_values(np.rint(labels), (-64, 64))
    assert whole.step == 1.0 and not whole.spikes
    holes = labels.copy()
    holes[:50] = 0
    assert label_checks.label_values(holes, (-64, 64)).spikes == [(0.0, 0.25)]
    holes[:50] = -9999
    bad = label_checks.label_values(holes, (-64, 64))
    assert bad.strays == [(-9999.0, 0.25)] and bad.outside == pytest.approx(0.25)
    assert label_checks.label_values(np.full((9, 9), np.nan), (-64, 64)).labelled == 0


def test_right_labels_are_not_contradicted_wrong_ones_are():
    scene = make(9)
    good = label_checks.scan_labels(*smoothed(scene), scene.labels, (-20.0, 30.0))
    assert good.x.size > 500
    assert good.beaten.mean() < 0.005
    wrong = scene.labels.copy()
    wrong[200:280, 20:120] += 7
    scan = label_checks.scan_labels(*smoothed(scene), wrong, (-20.0, 30.0))
    inside = (scan.x > 26) & (scan.x < 112) & (scan.y > 206) & (scan.y < 274)
    assert scan.beaten[inside].mean() > 0.8
    assert scan.beaten[~inside].mean() < 0.03
    assert scan.contradicted().value > 0.4 * inside.mean()


def test_noise_contradicts_nothing():
    """Where the images show no common thing, chance wins here as often as in the decoy."""
    rng = np.random.default_rng(11)
    left, right = (smooth(rng.normal(size=(384, 384)).astype(np.float32)) for _ in "lr")
    labels = np.zeros((384, 384), np.float32)
    scan = label_checks.scan_labels(left, right, labels, (-60.0, 60.0))
    share = scan.contradicted()
    assert scan.x.size > 500
    assert abs(share.value) <= max(4 * share.error, 0.01)


def test_hidden_labels_are_those_behind_the_block():
    scene = make(7)
    got = label_checks.hidden_labels(scene.exact)
    assert got[scene.hidden].mean() > 0.85  # all but the first px of the fold
    assert got[~scene.hidden].sum() == 0
    mirrored = -scene.exact[:, ::-1]  # heights that fall with d
    assert np.array_equal(label_checks.hidden_labels(mirrored, label_checks.SMALLER), got[:, ::-1])
    assert label_checks.hidden_labels(scene.labels).sum() == 0


def test_images_tell_which_side_of_a_fold_is_in_front():
    scene = make(8)
    left, right = grey(scene.left), grey(scene.right)
    low, _ = label_checks.who_is_in_front(left, right, scene.exact).interval(0.05)
    # one block spans few cells: the sign is right where it is known
    assert np.isinf(low) or low > 0
    left, right = (grey(image[:, ::-1]) for image in (scene.left, scene.right))
    _, high = label_checks.who_is_in_front(left, right, -scene.exact[:, ::-1]).interval(0.05)
    assert np.isinf(high) or high < 0


@pytest.mark.parametrize("move", [(0, 0), (2, 0), (0, -2)])
def test_labels_that_lie_on_wrong_pixels_are_found_beside_steps(move, monkeypatch):
    monkeypatch.setattr(label_checks, "MIN_PIXELS", 300)
    scene = make(17)
    labels = np.roll(scene.labels, move[::-1], axis=(0, 1))
    back, gain = label_checks.better_place(*smoothed(scene), labels)
    if move == (0, 0):
        assert gain.value < 0
    else:
        assert back == (-move[0], -move[1])
        assert gain.interval(0.001)[0] > 0.15
