"""The networks' structure, the published weights, and networks as methods."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.methods.kinds import NETWORKS
from stereobench.networks import inference, weights
from stereobench.networks.inference import NetworkMethod
from stereobench.networks.weights import SavedNetwork
from stereotruth.core.errors import InputError

from ...synthetic.small_networks import method

CPU = torch.device("cpu")


def test_any_size_is_matched_and_nodata_is_invalid() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.integers(1, 900, (2, 43, 70)).astype(np.uint16)
    left[:5] = 0
    found = method()(left, right, (-64, 64))
    assert found.shape == (43, 70) and found.dtype == np.float32
    assert np.isnan(found[:5]).all() and np.isfinite(found[5:]).all()


def test_parts_of_an_image_share_its_scaling() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 60000, (100, 90)).astype(np.uint16)
    known = image[image != 0].astype(float)
    mean, deviation = weights.image_scaling(image)
    assert (mean, deviation) == pytest.approx((known.mean(), known.std()))
    assert weights.image_scaling(da.from_array(image, chunks=37)) == (mean, deviation)
    scaling = method().scaling(image, image)
    part = weights.scaled(image[:10], method().model, scaling.left)
    assert np.array_equal(part, weights.scaled(image, method().model, None)[:, :10])


@pytest.mark.parametrize("kind", ["stereonet", "hmsmnet"])
def test_the_entropy_of_the_softmax_is_an_uncertainty(kind: str) -> None:
    """Of equal costs, that of a uniform distribution over all planes, in px of the image."""
    model = SavedNetwork(kind, (-64, 64))
    network = model.build()
    image = np.random.default_rng(0).integers(1, 900, (2, 60, 70)).astype(np.uint16)
    image[0, :3] = 0
    sure = NetworkMethod(model, network, CPU, "float32", "entropy")
    found, sigma = sure.with_uncertainty(*image, (-64, 64))
    assert np.array_equal(found, sure(*image, (-64, 64)), equal_nan=True)
    assert sigma.shape == (60, 70) and np.isnan(sigma[:3]).all()
    planes = {"stereonet": 8, "hmsmnet": 4}[kind]
    least, most = planes / np.sqrt(12), 128 / np.sqrt(12)
    assert np.nanmin(sigma) > 0.999 * least and np.nanmax(sigma) < 1.001 * most
    with torch.no_grad():
        network.expected.register_forward_pre_hook(lambda part, given: (0 * given[0], *given[1:]))
    _, sigma = sure.with_uncertainty(*image, (-64, 64))
    assert np.nanmin(sigma) == pytest.approx(most, rel=1e-4) == np.nanmax(sigma)


def test_flips_that_agree_leave_no_uncertainty() -> None:
    """What is the same upside down has none; other pairs have some."""
    image = np.random.default_rng(0).integers(1, 900, (2, 64, 64)).astype(np.uint16)
    network = method().network
    network.forward = lambda left, right: [left[:, 0] - right[:, 0]]
    of = NetworkMethod(method().model, network, CPU, "float32", "flips")
    assert np.nanmax(of.with_uncertainty(*image, (-64, 64))[1]) == 0
    rows = torch.arange(64.0)[:, None]
    network.forward = lambda left, right: [(rows + 0 * left[:, 0])]
    sigma = of.with_uncertainty(*image, (-64, 64))[1]
    assert sigma[0, 0] == pytest.approx(61.03 / np.sqrt(2), rel=0.01)  # rms of 63, 61 and 59
    assert method().with_uncertainty(*image, (-64, 64))[1] is None


def test_any_range_can_be_looked_for() -> None:
    """No weight depends on the range: planes outside the training's are looked at like others."""
    image = np.random.default_rng(0).integers(1, 900, (2, 32, 64)).astype(np.uint16)
    trained, other = method(), method()
    found = other(*image, (-61, 123))
    assert other.network.planes == (-8, 16)
    again = NetworkMethod(SavedNetwork("stereonet", (-64, 128)), trained.network, CPU, "float32")
    trained.network.set_range((-64, 128))
    assert np.array_equal(found, again(*image, (-64, 128)))


@pytest.mark.parametrize("kind", NETWORKS)
def test_ranges_are_widened_to_the_networks_planes(kind: str) -> None:
    assert weights.covering(kind, (-96, 96)) == (-96, 96)  # US3D's
    assert weights.covering(kind, (-128, 64)) == (-128, 64)  # WHU-Stereo's
    for wanted in ((-61, 123), (-1, 1), (3, 90)):
        low, high = weights.covering(kind, wanted)
        assert low <= wanted[0] and high >= wanted[1]
        SavedNetwork(kind, (low, high)).build()
    if kind == "densemapnet":  # takes any range
        return
    first = {"stereonet": -104, "psmnet": -104, "hmsmnet": -112}[kind]
    with pytest.raises(InputError, match=rf"multiples of .* take \({first}, "):
        SavedNetwork(kind, (-103, 90)).build()


def test_a_gpu_matches_at_the_precision_of_a_processor_and_trains_faster():
    gpu, before = torch.device("cuda"), torch.backends.cudnn.allow_tf32
    assert inference.precision_of(None, gpu) == "float32"
    assert inference.precision_of(None, gpu, "bfloat16") == "bfloat16"
    with inference.mixed("float32", gpu):
        assert not torch.backends.cudnn.allow_tf32
    assert torch.backends.cudnn.allow_tf32 == before
