"""Measures of the audit against analytic scenes."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.evaluation.audit import conventions, hidden, registration
from stereotruth.evaluation.audit.contradiction import scan_labels
from stereotruth.evaluation.audit.estimates import Estimate, cells, location, ratio, robust_fit
from stereotruth.evaluation.audit.matches import Matches, grey, label_offsets, match_pair, smooth
from stereotruth.evaluation.audit.pair import estimate, measure_arrays

from .audit_scene import BLOCK, HEIGHT_PX, make, sample, texture

MANY = 300  # matches that an image of 288 px gives at least


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.25, 0.0), (0.5, 0.5), (0.0, 1.0), (-0.3, -0.7)])
def test_matches_have_no_bias_at_any_phase(shift):
    scene = make(1, shift=shift)
    found = match_pair(scene.left, scene.right, 40)
    label = conventions.label_at(scene.labels, found.x, found.y)
    known = np.isfinite(label)
    error = (found.disparity - label)[known] + shift[0]
    assert known.sum() > MANY
    assert abs(np.median(error)) < 0.01
    assert abs(np.median(found.parallax) - shift[1]) < 0.01
    assert np.median(np.abs(error)) < 0.06


def test_colour_and_8_bit_are_matched_alike():
    scene = make(2, shift=(0.0, 0.4))
    small = [np.clip(image / 5, 0, 255).astype(np.uint8) for image in (scene.left, scene.right)]
    colour = [np.stack([image, image // 2, 255 - image], axis=-1) for image in small]
    found = match_pair(*colour, 40, nodata=False)
    assert len(found) > 100
    assert abs(np.median(found.parallax) - 0.4) < 0.03


def test_rows_that_are_far_off_are_found():
    scene = make(3, shift=(0.0, 17.3))
    found = match_pair(scene.left, scene.right, 40)
    assert len(found) > 100
    assert abs(np.median(found.parallax) - 17.3) < 0.02


def test_matches_of_large_disparities_of_either_sign():
    for offset in (-45.0, 60.0):
        found = match_pair(*_images(make(4, offset=offset)), 90)
        assert abs(np.median(found.disparity) - offset) < 3


def _images(scene):
    return scene.left, scene.right


def test_intervals_hold_what_they_promise():
    """Errors common to a cell: an interval that took the matches for independent would not hold."""
    rng = np.random.default_rng(5)
    covered = independent = 0
    runs = 200
    for _ in range(runs):
        x, y = rng.uniform(0, 1024, (2, 800))
        group = cells(x, y)
        shared = rng.normal(0, 0.1, group.max() + 1)[group]
        values = shared + rng.normal(0, 0.1, x.size)
        values[:80] += 8  # mismatches
        found = location(values, group)
        low, high = found.interval(0.05)
        covered += low <= 0 <= high
        wrong = 1.96 * np.std(values[80:]) / np.sqrt(720)
        independent += abs(found.value) <= wrong
    assert 0.90 <= covered / runs <= 0.99
    assert independent / runs < 0.85


def test_robust_fit_finds_a_trend_among_mismatches():
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-1, 1, (2, 2000))
    values = 0.3 - 0.5 * x + 0.2 * y + rng.normal(0, 0.1, x.size)
    values[:200] = rng.uniform(-5, 5, 200)
    design = np.column_stack([np.ones(x.size), x, y])
    found = robust_fit(design, values, cells(512 + 512 * x, 512 + 512 * y))
    for got, true in zip(found, (0.3, -0.5, 0.2)):
        assert abs(got.value - true) < 4 * got.error
        assert got.error < 0.01


def test_labels_are_held_against_matches_in_their_own_shape():
    """A match is the mean of its window: on a ridge, less than the label on its crest."""
    rng = np.random.default_rng(16)
    ground = texture(rng, 400)
    y, x = np.mgrid[:256, :256].astype(float)
    labels = 3.0 - 0.25 * np.abs((x + 8) % 16 - 8)
    columns = np.arange(256.0)
    inverse = np.interp(columns, columns - labels[0], columns)  # left column of each right one
    left, right = sample(ground, x, y), sample(ground, np.tile(inverse, (256, 1)), y)
    crest = (x[0] % 16 == 8) & (x[0] > 20) & (x[0] < 230)
    xs, ys = (v.ravel().astype(float) for v in np.meshgrid(columns[crest], np.arange(30, 230, 12)))
    none = np.zeros(xs.size)
    found = Matches(xs, ys, none + 0.9, none, none, none, none, none)
    for offset in (0.0, 0.4, -1.5):
        got = label_offsets(
            left.astype(np.float32), right.astype(np.float32), labels - 2.0 + offset, found
        )
        assert np.isfinite(got).mean() > 0.5
        assert np.nanmedian(got) == pytest.approx(offset - 2.0, abs=0.05)


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


def test_too_few_cells_say_nothing():
    found = location(np.zeros(50), np.zeros(50, np.int64))
    assert found.beyond(0.3, 0.01) is None
    assert Estimate(2.0, 0.1, 20).beyond(0.3, 0.01) is True
    assert Estimate(0.0, 0.01, 20).beyond(0.3, 0.01) is False
    assert Estimate(0.3, 0.05, 20).beyond(0.3, 0.01) is None
    assert ratio(np.ones(3), np.ones(3), np.arange(3)).beyond(0.5, 0.01) is None


def test_hidden_labels_are_those_behind_the_block():
    scene = make(7)
    got = hidden.hidden_labels(scene.exact)
    assert got[scene.hidden].mean() > 0.85  # all but the first px of the fold
    assert got[~scene.hidden].sum() == 0
    mirrored = -scene.exact[:, ::-1]  # heights that fall with d
    assert np.array_equal(hidden.hidden_labels(mirrored, hidden.SMALLER), got[:, ::-1])
    assert hidden.hidden_labels(scene.labels).sum() == 0


def test_images_tell_which_side_of_a_fold_is_in_front():
    scene = make(8)
    low, high = hidden.who_is_in_front(grey(scene.left), grey(scene.right), scene.exact).interval(
        0.05
    )
    # one block spans few cells: the sign is right where it is known
    assert np.isinf(low) or low > 0
    left, right = (grey(image[:, ::-1]) for image in (scene.left, scene.right))
    low, high = hidden.who_is_in_front(left, right, -scene.exact[:, ::-1]).interval(0.05)
    assert np.isinf(high) or high < 0


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
