"""Networks and their files of weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.networks import inference, weights
from stereobench.networks.weights import SavedNetwork
from stereotruth.core.errors import InputError

from ...synthetic.small_networks import method, write_as_keras


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
    with pytest.raises(InputError, match="weights of stereonet, not of psmnet"):
        inference.make("mine", "psmnet", settings, 0)
    file.write_bytes(b"no weights")
    with pytest.raises(InputError, match="not a weight file"):
        weights.load_weights(file)
    with pytest.raises(InputError, match="no such weight file"):
        weights.load_weights(tmp_path / "other.pt")


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    write_as_keras(method().network, tmp_path / "net.h5")
    with pytest.raises(InputError, match=r"layer 0: .* differs is number 0"):
        weights.load_keras(
            SavedNetwork("stereonet", (-64, 64), channels=3).build(), tmp_path / "net.h5"
        )
    with pytest.raises(InputError, match="5 layers with weights, PSMNet has"):
        weights.load_keras(SavedNetwork("psmnet", (-64, 64)).build(), tmp_path / "net.h5")
    (tmp_path / "text.h5").write_text("no weights")
    with pytest.raises(InputError, match="not a weight file of Keras"):
        weights.read_weights(tmp_path / "text.h5")
