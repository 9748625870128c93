"""Weights that Keras has written."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.networks import weights
from stereobench.networks.weights import SavedNetwork

from ...synthetic.small_networks import method, write_as_keras


def test_keras_weights_are_taken_by_order(tmp_path: Path) -> None:
    made = method().network
    write_as_keras(made, tmp_path / "net.h5")
    out = tmp_path / "net.pt"
    weights.main([str(tmp_path / "net.h5"), str(out), "--disparity-range", "-64", "64"])
    model, again, provenance = weights.load_weights(out)
    assert model == SavedNetwork("stereonet", (-64, 64)) and provenance == {"source": "net.h5"}
    for name, value in made.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
