"""Faults planted in images."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.methods.image_faults import FAULTS, blur, faulty_pair, haze, shadows, smooth

NEVER = dict.fromkeys(FAULTS, 0.0)


def image(*shape: int, dtype: type = np.uint16) -> np.ndarray:
    rng = np.random.default_rng(3)
    found = rng.integers(40, 250, shape).astype(dtype)
    found[:5] = 0  # nodata
    return found


def test_shadows_are_an_eighth_and_dark():
    rng = np.random.default_rng(0)
    bright = np.full((400, 400), 100.0, np.float32)
    found = shadows(bright, rng)
    assert (found == 40).mean() == pytest.approx(0.125, abs=0.001)
    assert (found == 100).mean() == pytest.approx(0.875, abs=0.001)
    np.testing.assert_allclose(np.unique(shadows(bright, rng, 0.5)), [70, 100])


def test_blur_spreads_a_point_by_its_deviation():
    point = np.zeros((41, 41), np.float32)
    point[20, 20] = 1.0
    found = blur(point, np.random.default_rng(0), 2.0)
    offset = np.arange(41) - 20
    assert np.sqrt((found.sum(axis=0) * offset**2).sum()) == pytest.approx(3.0, abs=0.1)


def test_haze_takes_contrast_and_gives_light_by_places():
    rng = np.random.default_rng(0)
    texture = np.random.default_rng(1).normal(200, 20, (800, 800)).astype(np.float32)
    found = haze(texture, rng)
    share = smooth((800, 800), 256, np.random.default_rng(0)).clip(0, 1)
    clear, hazy = share < 0.2, share > 0.8
    assert found[hazy].std() < 0.75 * found[clear].std()
    np.testing.assert_allclose(found, texture * (1 - 0.5 * share) + share * texture.std())


def test_nothing_changes_without_a_chance():
    left, right = image(60, 70), image(60, 70)[::-1].copy()
    for found, given in zip(
        faulty_pair(left, right, NEVER, np.random.default_rng(0)), (left, right)
    ):
        np.testing.assert_array_equal(found, given)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize(("shape", "dtype"), [((600, 400), np.uint16), ((600, 400, 3), np.uint8)])
def test_one_image_of_the_pair_gets_the_fault_and_nodata_stays(fault, shape, dtype):
    pair = image(*shape, dtype=dtype), image(*shape, dtype=dtype)[:, ::-1].copy()
    sides = []
    for seed in range(6):
        found = faulty_pair(*pair, NEVER | {fault: 1.0}, np.random.default_rng(seed))
        again = faulty_pair(*pair, NEVER | {fault: 1.0}, np.random.default_rng(seed))
        for one, other, given in zip(found, again, pair):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == dtype and one.shape == shape
            np.testing.assert_array_equal(one == 0, given == 0)
        (side,) = (k for k in range(2) if (found[k] != pair[k]).any())
        sides.append(side)
    assert set(sides) == {0, 1}


def test_chances_are_kept():
    pair = image(40, 40), image(40, 40)
    rng = np.random.default_rng(0)
    changed = [
        any((a != b).any() for a, b in zip(faulty_pair(*pair, NEVER | {"blur": 0.3}, rng), pair))
        for _ in range(300)
    ]
    assert np.mean(changed) == pytest.approx(0.3, abs=0.08)
