"""Grey values as the networks take them."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereotruth.matching.networks import image_scaling

from ....synthetic.small_networks import method


def test_wide_grey_values_are_brought_to_8_bits_alike_in_all_parts() -> None:
    made = method(channels=3, scaling="us3d")
    image = np.random.default_rng(0).integers(1, 60000, (64, 80)).astype(np.uint16)
    image[:32] //= 10
    statistics = made.scaling(image, da.from_array(image, chunks=30))
    assert statistics.left == statistics.right
    whole = image_scaling.scaled(image, made.model, None)
    assert np.array_equal(
        image_scaling.scaled(image[:32], made.model, statistics.left), whole[:, :32]
    )
    assert whole.min() >= -1 and whole.max() == 1
    eight = (image >> 8).astype(np.uint8)
    assert made.scaling(eight, eight) == (None, None)
    expected = eight.astype(np.float32) / 127.5 - 1
    np.testing.assert_allclose(
        image_scaling.scaled(eight, made.model, None)[1], expected, atol=1e-6
    )
