"""Networks from files of either kind: the weight files (.pt) here, and Keras' (.h5)."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from .keras_weights import read_keras
from .weights import SavedNetwork, load_weights


def load_network(
    path: str | Path, kind: str, scaling: str | None = None
) -> tuple[SavedNetwork, nn.Module]:
    """The network of a file, which tells its kind itself; one of Keras is taken for ``kind``.

    ``scaling``: of the images for a file of Keras, see :func:`keras_weights.read_keras`.
    Raises InputError if there is no such file, or it does not hold the network's weights.
    """
    if Path(path).suffix in (".h5", ".hdf5"):
        return read_keras(path, kind, scaling)
    model, network, _ = load_weights(path)
    return model, network
