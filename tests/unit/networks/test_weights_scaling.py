"""Grey values as the networks take them."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.methods.methods import with_polarity
from stereobench.networks import weights

from ...synthetic.small_networks import method


def test_wide_grey_values_are_brought_to_8_bits_alike_in_all_parts() -> None:
    made = method(channels=3, scaling="us3d")
    image = np.random.default_rng(0).integers(1, 60000, (64, 80)).astype(np.uint16)
    image[:32] //= 10
    statistics = made.scaling(image, da.from_array(image, chunks=30))
    assert statistics.left == statistics.right
    whole = weights.scaled(image, made.model, None)
    assert np.array_equal(weights.scaled(image[:32], made.model, statistics.left), whole[:, :32])
    assert whole.min() >= -1 and whole.max() == 1
    eight = (image >> 8).astype(np.uint8)
    assert made.scaling(eight, eight) == (None, None)
    expected = eight.astype(np.float32) / 127.5 - 1
    np.testing.assert_allclose(weights.scaled(eight, made.model, None)[1], expected, atol=1e-6)


@pytest.mark.parametrize("polarity", ["any", "positive", "mirrored"])
@pytest.mark.parametrize("scaling", ["us3d", "dfc2019", "standardise"])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_network_of_each_polarity_and_scaling_says_something(polarity, scaling, channels):
    """PyTorch refuses arrays that run backwards, as one band in blue-first order did."""
    asked = with_polarity("n", method(channels=channels, scaling=scaling), polarity)
    left, right = np.random.default_rng(1).integers(1, 255, (2, 64, 96)).astype(np.uint8)
    found = asked(left, right, (-64, 0), asked.scaling(left, right))
    assert found.shape == left.shape and np.isfinite(found).all()
