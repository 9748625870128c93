"""Faults planted in images."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.methods.image_faults import FAULTS, blur, faulty_pair, haze, shadows, smooth

NEVER = dict.fromkeys(FAULTS, 0.0)


def test_each_fault_is_as_strong_as_it_says():
    bright = np.full((400, 400), 100.0, np.float32)
    dark = shadows(bright, np.random.default_rng(0))
    assert (dark == 40).mean() == pytest.approx(0.125, abs=0.001)
    assert (dark == 100).mean() == pytest.approx(0.875, abs=0.001)
    point = np.zeros((41, 41), np.float32)
    point[20, 20] = 1.0
    spread = blur(point, np.random.default_rng(0), 2.0).sum(axis=0)
    assert np.sqrt((spread * (np.arange(41) - 20) ** 2).sum()) == pytest.approx(3.0, abs=0.1)
    texture = np.random.default_rng(1).normal(200, 20, (800, 800)).astype(np.float32)
    share = smooth((800, 800), 256, np.random.default_rng(0)).clip(0, 1)
    expected = texture * (1 - 0.5 * share) + share * texture.std()
    np.testing.assert_allclose(haze(texture, np.random.default_rng(0)), expected)


@pytest.mark.parametrize(("shape", "dtype"), [((300, 200), np.uint16), ((300, 200, 3), np.uint8)])
def test_one_image_of_the_pair_gets_the_fault_and_nodata_stays(shape, dtype):
    image = np.random.default_rng(3).integers(40, 250, shape).astype(dtype)
    image[:5] = 0
    pair = image, image[:, ::-1].copy()
    for fault in FAULTS:
        sides = set()
        for seed in range(6):
            found, again = (
                faulty_pair(*pair, NEVER | {fault: 1.0}, np.random.default_rng(seed))
                for _ in range(2)
            )
            for one, other, given in zip(found, again, pair):
                np.testing.assert_array_equal(one, other)
                assert one.dtype == dtype and np.array_equal(one == 0, given == 0)
            sides |= {k for k in range(2) if (found[k] != pair[k]).any()}
        assert sides == {0, 1}


def test_chances_are_kept():
    image = np.random.default_rng(3).integers(40, 250, (40, 40)).astype(np.uint16)
    rng = np.random.default_rng(0)
    changed = [
        any((of != image).any() for of in faulty_pair(image, image, NEVER | {"blur": 0.3}, rng))
        for _ in range(300)
    ]
    assert np.mean(changed) == pytest.approx(0.3, abs=0.08)
