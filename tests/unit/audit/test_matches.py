"""Matches between the images of a pair, of known offsets, and between images of shared ground."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import matches as module
from stereobench.audit.label_checks import label_at
from stereobench.audit.matches import (
    Matches,
    compare,
    features,
    find_shared,
    label_offsets,
    match_pair,
)

from ...synthetic.pair_with_block import make, sample, texture

MANY = 300  # matches that an image of 288 px gives at least


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (-0.3, -0.7)])
def test_matches_have_no_bias_at_any_phase(shift):
    scene = make(1, shift=shift)
    found = match_pair(scene.left, scene.right, 40)
    label = label_at(scene.labels, found.x, found.y)
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
    assert found.x.size > 100
    assert abs(np.median(found.parallax) - 0.4) < 0.03


def test_rows_that_are_far_off_and_large_disparities_of_either_sign_are_found():
    scene = make(3, shift=(0.0, 17.3))
    found = match_pair(scene.left, scene.right, 40)
    assert found.x.size > 100
    assert abs(np.median(found.parallax) - 17.3) < 0.02
    for offset in (-45.0, 60.0):
        scene = make(4, offset=offset)
        assert abs(np.median(match_pair(scene.left, scene.right, 90).disparity) - offset) < 3


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
    found = Matches(xs, ys, none + 0.9, none)
    for offset in (0.0, -1.5):
        got = label_offsets(
            left.astype(np.float32), right.astype(np.float32), labels - 2.0 + offset, found
        )
        assert np.isfinite(got).mean() > 0.5
        assert np.nanmedian(got) == pytest.approx(offset - 2.0, abs=0.05)


def overlapping(shift, seed, angle=0.0):
    """Two looks at one ground, ``shift`` px apart, and one at another."""
    rng = np.random.default_rng(seed)
    ground, other = texture(rng, 800), texture(rng, 800)
    y, x = np.mgrid[:300, :300].astype(float)
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    looks = [
        sample(ground, x, y),
        0.7 * sample(ground, c * x - s * y + shift, s * x + c * y) + 90,
        sample(other, x, y),
    ]
    return [np.rint(look + rng.normal(0, 4, look.shape)).astype(np.uint16) for look in looks]


@pytest.mark.parametrize("shift, angle", [(210, 0), (110, 12)])
def test_shared_ground(shift, angle):
    (found,) = find_shared([features(image) for image in overlapping(shift, 60, angle)])
    assert (found.first, found.second) == (0, 1)
    if not angle:
        assert found.share == pytest.approx(1 - shift / 300, abs=0.02)


@pytest.mark.slow
def test_of_many_images_only_likely_pairs_are_compared(monkeypatch):
    monkeypatch.setattr(module, "COMPARED", 0)
    asked = []
    monkeypatch.setattr(module, "compare", lambda a, b: asked.append((a, b)) or compare(a, b))
    rng = np.random.default_rng(63)
    others = [texture(rng, 200).astype(np.uint16) for _ in range(20)]
    (found,) = find_shared([features(image) for image in overlapping(110, 64) + others])
    assert (found.first, found.second) == (0, 1)
    assert len(asked) < 60  # of 253


def test_unrelated_images_share_nothing():
    """By chance an image has few matches with the mirror images of others: none is its own."""
    rng = np.random.default_rng(61)
    images = [texture(rng, 300).astype(np.uint16) for _ in range(4)]
    plain = [features(image) for image in images]
    assert find_shared(plain) == []
    mirrored = [features(np.ascontiguousarray(image[:, ::-1])) for image in images]
    chance = [compare(a, b)[0] for i, a in enumerate(plain) for b in mirrored[i + 1 :]]
    assert max(chance) < module.MIN_INLIERS
    assert find_shared([features(np.zeros((64, 64), np.uint16))] * 2) == []
