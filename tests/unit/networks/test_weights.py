"""Networks, their files of weights, Keras' too, and grey values as the networks take them."""

from __future__ import annotations

from pathlib import Path

import dask.array as da
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
h5py = pytest.importorskip("h5py", reason="h5py is not installed: make test-networks")
from stereobench.methods.methods import with_polarity
from stereobench.networks import inference, weights
from stereobench.networks.weights import SavedNetwork, read_weights
from stereotruth.core.errors import InputError

from ...synthetic.small_networks import method, write_as_keras

KERNEL = np.arange(6, dtype=np.float32).reshape(2, 3)


@pytest.mark.parametrize(
    "kind, trained, statistics",
    [
        ("stereonet", 621380, 3712),
        ("psmnet", 1882704, 6528),
        ("hmsmnet", 1308788, 3776),
    ],
)
def test_parameters_are_as_many_as_the_authors(kind: str, trained: int, statistics: int) -> None:
    network = SavedNetwork(kind, (-128, 64)).build()
    assert sum(p.numel() for p in network.parameters()) == trained
    held = dict(network.named_buffers())
    assert sum(b.numel() for k, b in held.items() if "running" in k) == statistics


def test_weight_files_hold_all_that_is_needed(tmp_path: Path) -> None:
    made = method()
    file = tmp_path / "weights.pt"
    weights.save_weights(file, made.model, made.network, {"from": "here"})
    settings = {"weights": str(file), "device": "cpu"}
    again = inference.make("mine", "stereonet", settings, 0)
    image = np.random.default_rng(1).integers(1, 900, (2, 64, 64)).astype(np.uint16)
    assert np.array_equal(made(*image, (-64, 64)), again(*image, (-64, 64)))
    with pytest.raises(InputError, match="weight"):
        inference.make("mine", "psmnet", settings, 0)
    file.write_bytes(b"no weights")
    with pytest.raises(InputError, match="weight"):
        weights.load_weights(file)
    with pytest.raises(InputError, match="weight"):
        weights.load_weights(tmp_path / "other.pt")


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    write_as_keras(method().network, tmp_path / "net.h5")
    with pytest.raises(InputError, match="layer 0"):
        weights.load_keras(
            SavedNetwork("stereonet", (-64, 64), channels=3).build(), tmp_path / "net.h5"
        )
    with pytest.raises(InputError, match="PSMNet"):
        weights.load_keras(SavedNetwork("psmnet", (-64, 64)).build(), tmp_path / "net.h5")
    (tmp_path / "text.h5").write_text("no weights")
    with pytest.raises(InputError, match="text"):
        weights.read_weights(tmp_path / "text.h5")


def test_keras_weights_are_taken_by_order(tmp_path: Path) -> None:
    made = method().network
    write_as_keras(made, tmp_path / "net.h5")
    model, again = weights.read_keras(tmp_path / "net.h5", "stereonet", None, (-64, 64))
    assert model == SavedNetwork("stereonet", (-64, 64))
    for name, value in made.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def keras_file(path: Path, *names: str) -> h5py.File:
    """A file of one layer whose arrays have these names; they are the caller's to make."""
    file = h5py.File(path, "w")
    group = file.create_group("layer")
    group.attrs["weight_names"] = [name.encode() for name in names]
    file.attrs["layer_names"] = [b"layer"]
    return file


def link(file: h5py.File, to: object) -> None:
    file["layer/there"] = KERNEL
    file["layer/it"] = to


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((2, 3), "f4")
    layout[:] = h5py.VirtualSource("secret.h5", "it", (2, 3))
    file.create_virtual_dataset("layer/it", layout)


def circle(file: h5py.File) -> None:
    file["layer/loop"] = file["layer"]
    file["layer/it"] = KERNEL


def large(file: h5py.File) -> None:
    file.create_dataset("layer/it", (10**6, 10**6), "f4", chunks=(1000, 1000))


BAD_FILES = {
    "soft link": lambda file: link(file, h5py.SoftLink("/layer/there")),
    "circle of links": lambda file: link(file, h5py.SoftLink("/layer/it")),
    "link to a file": lambda file: link(file, h5py.ExternalLink("secret.h5", "/it")),
    "values of a file": lambda file: file.create_dataset(
        "layer/it", (6,), "f4", external=[("secret", 0, 24)]
    ),
    "values of an h5 file": virtual,
    "circle of groups": circle,
    "4 TB": large,
    "text": lambda file: link(file, "text"),
    "group": lambda file: file.create_group("layer/it"),
}


@pytest.mark.parametrize("fault", BAD_FILES)
def test_files_of_keras_that_lead_elsewhere_or_to_too_much_are_refused(tmp_path, fault) -> None:
    name = "loop/" * 1000 + "it" if fault == "circle of groups" else "it"
    with keras_file(tmp_path / "w.h5", name) as file:
        BAD_FILES[fault](file)
    with pytest.raises(InputError, match=r"w\.h5: .*Remedy") as error:
        read_weights(tmp_path / "w.h5")
    assert "\n" not in str(error.value)


def test_one_array_named_again_and_again_counts_each_time(tmp_path) -> None:
    with keras_file(tmp_path / "w.h5", *["it"] * 3000) as file:
        file.create_dataset("layer/it", (1000, 1000), "f4", chunks=(1000, 1000))
    with pytest.raises(InputError, match="GB"):
        read_weights(tmp_path / "w.h5")


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


@pytest.mark.parametrize("polarity", ["positive", "mirrored"])
@pytest.mark.parametrize("scaling", ["us3d", "dfc2019", "standardise"])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_network_of_each_polarity_and_scaling_says_something(polarity, scaling, channels):
    """PyTorch refuses arrays that run backwards, as one band in blue-first order did."""
    asked = with_polarity("n", method(channels=channels, scaling=scaling), polarity)
    left, right = np.random.default_rng(1).integers(1, 255, (2, 64, 96)).astype(np.uint8)
    found = asked(left, right, (-64, 0), asked.scaling(left, right))
    assert found.shape == left.shape and np.isfinite(found).all()
