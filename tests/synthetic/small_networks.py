"""Networks of random weights, and files of weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stereobench.networks import weights
from stereobench.networks.inference import NetworkMethod
from stereobench.networks.weights import SavedNetwork

h5py = pytest.importorskip("h5py", reason="h5py is not installed: make test-networks")
CPU = torch.device("cpu")


def method(kind: str = "stereonet", **settings: object) -> NetworkMethod:
    torch.manual_seed(3)
    model = SavedNetwork(kind, (-64, 64), **settings)
    return NetworkMethod(model, model.build(), CPU, "float32")


def write_as_keras(network: torch.nn.Module, path: Path) -> None:
    """A file as Keras makes it: names that mean nothing, arrays in calling order."""
    with h5py.File(path, "w") as file:
        names = []
        for number, part in enumerate(weights._parts(network)):
            group = file.create_group(f"part_{9 - number}")
            arrays = []
            for k, (tensor, axes) in enumerate(weights._slots(part)):
                array = tensor.detach().numpy().transpose(np.argsort(axes))
                group[f"w_{100 - k}"] = array
                arrays.append(f"w_{100 - k}")
            group.attrs["weight_names"] = [name.encode() for name in arrays]
            names.append(f"part_{9 - number}")
        file.create_group("input_1").attrs["weight_names"] = np.array([], "S1")
        file.attrs["layer_names"] = [name.encode() for name in ["input_1", *names]]
