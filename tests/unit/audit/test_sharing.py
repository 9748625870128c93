"""Ground that several pairs show."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit import sharing

from ...synthetic.pair_with_block import sample, texture


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


@pytest.mark.parametrize("shift, angle", [(0, 0), (140, 0), (210, 0), (110, 12)])
def test_shared_ground(shift, angle):
    images = [sharing.features(image) for image in overlapping(shift, 60, angle)]
    (found,) = sharing.find_shared(images)
    assert (found.first, found.second) == (0, 1)
    if not angle:
        assert found.share == pytest.approx(1 - shift / 300, abs=0.02)


@pytest.mark.slow
def test_of_many_images_only_likely_pairs_are_compared(monkeypatch):
    monkeypatch.setattr(sharing, "ALL", 0)
    rng = np.random.default_rng(63)
    others = [texture(rng, 200).astype(np.uint16) for _ in range(20)]
    images = [sharing.features(image) for image in overlapping(110, 64) + others]
    assert len(sharing._candidates(images)) < 60  # of 253
    (found,) = sharing.find_shared(images)
    assert (found.first, found.second) == (0, 1)


def test_unrelated_images_share_nothing():
    rng = np.random.default_rng(61)
    images = [texture(rng, 300).astype(np.uint16) for _ in range(4)]
    assert sharing.find_shared([sharing.features(image) for image in images]) == []
    assert max(sharing.chance_inliers(images)) < sharing.MIN_INLIERS
    assert sharing.find_shared([sharing.features(np.zeros((64, 64), np.uint16))] * 2) == []
