"""The networks' structure, the published weights, and networks as methods."""

from __future__ import annotations

from pathlib import Path

import dask.array as da
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
h5py = pytest.importorskip("h5py", reason="h5py is not installed: make test-networks")
from stereotruth.errors import InputError
from stereotruth.matching.kinds import NETWORKS
from stereotruth.matching.networks import image_scaling, inference, keras_weights, layers, weights
from stereotruth.matching.networks.inference import NetworkMethod
from stereotruth.matching.networks.psmnet import PSMNet
from stereotruth.matching.networks.weights import SavedNetwork

from .conftest import SHARED

CPU = torch.device("cpu")
with_published = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no published weights at {SHARED}")


@pytest.mark.parametrize(
    "kind, trained, statistics",
    [("stereonet", 621380, 3712), ("psmnet", 1882704, 6528), ("hmsmnet", 1308788, 3776)],
)
def test_parameters_are_as_many_as_the_authors(kind: str, trained: int, statistics: int) -> None:
    network = SavedNetwork(kind, (-128, 64)).build()
    assert sum(p.numel() for p in network.parameters()) == trained
    held = dict(network.named_buffers())
    assert sum(b.numel() for k, b in held.items() if "running" in k) == statistics


@pytest.mark.parametrize("kind", sorted(NETWORKS))
def test_outputs_have_the_sizes_that_the_loss_expects(kind: str) -> None:
    network = SavedNetwork(kind, (-64, 64)).build()
    side = 256
    pair = torch.randn(2, 1, 1, side, 2 * side)
    with torch.no_grad():
        outputs = network.train()(*pair)
        final = network.eval()(*pair)
    sizes = {"hmsmnet": (16, 8, 4, 1)}.get(kind, (1,) * len(network.loss_weights))
    assert [o.shape for o in outputs] == [(1, side // s, 2 * side // s) for s in sizes]
    assert len(outputs) == len(network.loss_weights)
    assert [o.shape for o in final] == [(1, side, 2 * side)]


def test_disparities_of_psmnet_are_those_of_costs_spread_to_full_size() -> None:
    network = PSMNet((-32, 32))
    cost = torch.randn(1, 16, 3, 5)
    spread = torch.nn.functional.interpolate(cost[:, None], scale_factor=4, mode="nearest")[:, 0]
    full = layers.soft_argmin(spread, -32.0)
    torch.testing.assert_close(network._disparity(cost), full)


def method(kind: str = "stereonet", **settings: object) -> NetworkMethod:
    torch.manual_seed(3)
    model = SavedNetwork(kind, (-64, 64), **settings)
    return NetworkMethod(model, model.build(), CPU, "float32")


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
    mean, deviation = image_scaling.image_scaling(image)
    assert (mean, deviation) == pytest.approx((known.mean(), known.std()))
    assert image_scaling.image_scaling(da.from_array(image, chunks=37)) == (mean, deviation)
    scaling = method().scaling(image, image)
    part = image_scaling.scaled(image[:10], method().model, scaling.left)
    assert np.array_equal(part, image_scaling.scaled(image, method().model, None)[:, :10])


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
    first = {"stereonet": -104, "psmnet": -104, "hmsmnet": -112}[kind]
    with pytest.raises(InputError, match=rf"multiples of .* take \({first}, "):
        SavedNetwork(kind, (-103, 90)).build()


def test_weight_files_hold_all_that_is_needed(tmp_path: Path) -> None:
    made = method()
    file = tmp_path / "weights.pt"
    weights.save_weights(file, made.model, made.network, {"from": "here"})
    settings = {"weights": str(file), "device": "cpu"}
    again = inference.make("mine", "stereonet", settings, 0)
    image = np.random.default_rng(1).integers(1, 900, (2, 64, 64)).astype(np.uint16)
    assert np.array_equal(made(*image, (-64, 64)), again(*image, (-64, 64)))
    with pytest.raises(InputError, match="weights of stereonet, not of psmnet"):
        inference.make("mine", "psmnet", settings, 0)
    file.write_bytes(b"no weights")
    with pytest.raises(InputError, match="not a weight file"):
        weights.load_weights(file)
    with pytest.raises(InputError, match="no such weight file"):
        weights.load_weights(tmp_path / "other.pt")


def write_as_keras(network: torch.nn.Module, path: Path) -> None:
    """A file as Keras makes it: names that mean nothing, arrays in calling order."""
    with h5py.File(path, "w") as file:
        names = []
        for number, part in enumerate(keras_weights._parts(network)):
            group = file.create_group(f"part_{9 - number}")
            arrays = []
            for k, (tensor, axes) in enumerate(keras_weights._slots(part)):
                array = tensor.detach().numpy().transpose(np.argsort(axes))
                group[f"w_{100 - k}"] = array
                arrays.append(f"w_{100 - k}")
            group.attrs["weight_names"] = [name.encode() for name in arrays]
            names.append(f"part_{9 - number}")
        file.create_group("input_1").attrs["weight_names"] = np.array([], "S1")
        file.attrs["layer_names"] = [name.encode() for name in ["input_1", *names]]


def test_keras_weights_are_taken_by_order(tmp_path: Path) -> None:
    made = method().network
    write_as_keras(made, tmp_path / "net.h5")
    out = tmp_path / "net.pt"
    keras_weights.main([str(tmp_path / "net.h5"), str(out), "--disparity-range", "-64", "64"])
    model, again, provenance = weights.load_weights(out)
    assert model == SavedNetwork("stereonet", (-64, 64)) and provenance == {"source": "net.h5"}
    for name, value in made.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    write_as_keras(method().network, tmp_path / "net.h5")
    with pytest.raises(InputError, match=r"layer 0: .* differs is number 0"):
        keras_weights.load_keras(
            SavedNetwork("stereonet", (-64, 64), channels=3).build(), tmp_path / "net.h5"
        )
    with pytest.raises(InputError, match="5 layers with weights, PSMNet has"):
        keras_weights.load_keras(SavedNetwork("psmnet", (-64, 64)).build(), tmp_path / "net.h5")
    (tmp_path / "text.h5").write_text("no weights")
    with pytest.raises(InputError, match="not a weight file of Keras"):
        keras_weights.read_weights(tmp_path / "text.h5")


@with_published
@pytest.mark.parametrize("name, channels, span", [("WHU", 1, (-128, 64)), ("US3D", 3, (-96, 96))])
def test_published_stereonet_gives_the_reference_outputs(
    name: str, channels: int, span: tuple[int, int]
) -> None:
    """All four outputs of the authors' code under TensorFlow, within 1e-3 px."""
    network = SavedNetwork("stereonet", span, channels).build()
    keras_weights.load_keras(network, SHARED / f"weights/StereoNet_{name}.h5")
    reference = np.load(SHARED / f"reference/stereonet_{name}_synth256.npz")
    images = [
        torch.from_numpy(reference[k].transpose(2, 0, 1)[None].copy()) for k in ("left", "right")
    ]
    network.eval()
    network.training = True  # all outputs, the layers below as they are in use
    with torch.no_grad():
        found = network(*images)
    for k, disparity in enumerate(found):
        assert np.abs(disparity[0].numpy() - reference[f"d{k}"]).max() < 1e-3


@with_published
def test_published_stereonet_matches_a_real_tile_from_its_raw_pixels() -> None:
    settings = {"weights": SHARED / "weights/StereoNet_WHU.h5", "device": "cpu"}
    reference = np.load(SHARED / "reference/real_WHU_KM_253_crop512.npz")
    found = inference.make("mine", "stereonet", settings, 0)(
        reference["raw_left"], reference["raw_right"], (-128, 64)
    )
    assert np.abs(found - reference["d3"]).max() < 1e-3
