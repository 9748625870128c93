"""Weight files of networks, with what is needed to use them."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import nn

from ...errors import InputError
from ...products.files import atomic_file
from ..kinds import KINDS


def network_class(kind: str) -> type[nn.Module]:
    """The network of a kind; by its name, so that digests of one do not hold the others' code."""
    module, _, name = KINDS[kind].network.partition(":")
    return getattr(importlib.import_module(f"stereotruth.{module}"), name)


def scaling_of(kind: str, channels: int) -> str:
    """The scaling of images that a kind of network is trained with."""
    return (
        getattr(network_class(kind), "colour_scaling", "us3d") if channels == 3 else "standardise"
    )


@dataclass(frozen=True)
class SavedNetwork:
    """What a network is made of besides its weights.

    ``kind`` of :data:`kinds.NETWORKS`; ``disparity_range`` in px, max exclusive; ``channels`` of
    its images (1 or 3); ``scaling``: ``standardise`` (each image by its mean and standard
    deviation, as for WHU-Stereo), ``us3d`` (8-bit values to -1 ... 1, blue first, as for US3D) or
    ``dfc2019`` (8-bit values to -1/2 ... 1/2, red first, as for the contest's DenseMapNet).
    """

    kind: str
    disparity_range: tuple[int, int]
    channels: int = 1
    scaling: str = "standardise"

    def build(self) -> nn.Module:
        """The network with fresh weights, from torch's random numbers.

        Raises InputError if its planes cannot cover the range.
        """
        try:
            return network_class(self.kind)(self.disparity_range, self.channels)
        except ValueError as error:
            raise InputError(
                f"{self.kind}: {error}", remedy=f"take {covering(self.kind, self.disparity_range)}"
            ) from error


def save_weights(
    path: str | Path, model: SavedNetwork, network: nn.Module, provenance: Mapping[str, Any]
) -> None:
    """Write a weight file in one step."""
    record = {
        "model": asdict(model),
        "weights": {name: value.cpu() for name, value in network.state_dict().items()},
        "provenance": dict(provenance),
    }
    with atomic_file(path) as scratch:
        torch.save(record, scratch)


def load_weights(path: str | Path) -> tuple[SavedNetwork, nn.Module, dict[str, Any]]:
    """The network of a weight file, and the file's provenance.

    Raises InputError if there is no such file, or it is another kind of file.
    """
    try:
        record = torch.load(path, map_location="cpu", weights_only=True)
        model = SavedNetwork(
            **{**record["model"], "disparity_range": tuple(record["model"]["disparity_range"])}
        )
        network = model.build()
        network.load_state_dict(record["weights"])
    except FileNotFoundError as error:
        raise InputError(
            "no such weight file", file=path, remedy="train the network, or name its weights"
        ) from error
    except (OSError, RuntimeError, KeyError, TypeError, ValueError, UnpicklingError) as error:
        raise InputError(
            f"not a weight file of this version ({type(error).__name__})",
            file=path,
            remedy="train the network again; Keras weights (.h5) are converted by "
            "python -m stereotruth.matching.networks.keras_weights",
        ) from error
    return model, network, record["provenance"]


def covering(kind: str, wanted: tuple[int, int]) -> tuple[int, int]:
    """The least disparity range of a network's planes that holds the ``wanted`` one, px."""
    of = network_class(kind)
    first = wanted[0] // of.plane_px * of.plane_px
    step = of.plane_px * of.planes_divisor
    return first, first + -(-(wanted[1] - first) // step) * step
