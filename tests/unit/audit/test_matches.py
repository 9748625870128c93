"""Matches between the images of a pair, of known offsets."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import conventions
from stereobench.audit.matches import Matches, label_offsets, match_pair

from ...synthetic.pair_with_block import make, sample, texture

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
