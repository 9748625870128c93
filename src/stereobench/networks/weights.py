"""Weight files of networks with what is needed to use them; images as a network takes them."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import dask
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_file

from ..methods.kinds import KINDS

SCALINGS = ("standardise", "us3d", "dfc2019")
SAMPLES = 1 << 22  # pixels that a quantile is taken from
GREY = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R BT.601)


class Scaling(NamedTuple):
    """What the blocks of both images must share, see :func:`image_statistics`."""

    left: tuple[float, float] | None
    right: tuple[float, float] | None


def image_statistics(image: Any, scaling: str) -> tuple[float, float] | None:
    """What the scaling of an image follows from (NumPy or Dask array of any size).

    ``standardise``: mean and standard deviation. Others: 0 and the grey value that becomes the
    brightest of 8 bits, above 99.9 % of the pixels that have data (of large images every k-th pixel
    of every k-th row is looked at); None for images of 8 bits, which stay as they are.
    """
    if scaling == "standardise":
        return image_scaling(image)
    if image.dtype == np.uint8:
        return None
    step = math.ceil(math.sqrt(math.prod(image.shape[:2]) / SAMPLES))
    values = np.asarray(image[::step, ::step])
    values = values[values != 0]
    return 0.0, float(np.quantile(values, 0.999)) if values.size else 1.0


def image_scaling(image: Any) -> tuple[float, float]:
    """Mean and standard deviation over the pixels of an image that are not nodata (0).

    NumPy or Dask array of any size; exact sums, so the same whatever the blocks.
    """
    whole = np.issubdtype(image.dtype, np.integer)
    wide = np.uint64 if whole else np.float64
    sums = (image != 0).sum(), image.sum(dtype=wide), (image.astype(wide) ** 2).sum()
    n, s, q = dask.compute(*sums)
    if not n:
        return 0.0, 1.0
    mean = int(s) / int(n) if whole else float(s) / int(n)
    variance = float(q) / int(n) - mean * mean
    return mean, max(variance, 0.0) ** 0.5 or 1.0


def scaled(
    image: NDArray[Any], model: SavedNetwork, statistics: tuple[float, float] | None
) -> NDArray[np.float32]:
    """[H, W] or [H, W, 3] pixels -> [C, H, W] as the network takes them; nodata becomes 0.

    ``statistics`` of the whole image; None: of this one.
    """
    grey = image.ndim == 2
    first, second = statistics or image_statistics(image, model.scaling) or (0.0, 255.0)
    if model.scaling != "standardise":
        bands = np.repeat(image[..., None], 3, axis=2) if grey else image
        bands = np.minimum(bands.astype(np.float32) * np.float32(255 / second), 255)
        bands = bands / np.float32(127.5) - 1
        if model.channels == 1:
            bands = bands @ np.array(GREY, np.float32)[:, None]
        bands = bands[..., ::-1] if model.scaling == "us3d" else bands / 2
        # copies: of one band, NumPy takes a reversed axis for contiguous, and PyTorch refuses it
        return bands.transpose(2, 0, 1).astype(np.float32, order="C").copy()
    if not grey and model.channels == 1:
        image = image @ np.array(GREY, np.float32)
    out = (image.astype(np.float32) - np.float32(first)) / np.float32(second)
    out[image == 0] = 0
    if out.ndim == 2:
        return np.repeat(out[None], model.channels, axis=0)
    return np.ascontiguousarray(out.transpose(2, 0, 1))


def network_class(kind: str) -> type[nn.Module]:
    """The network of a kind; by its name, so that digests of one do not hold the others' code."""
    module, _, name = KINDS[kind].network.partition(":")
    return getattr(importlib.import_module(module), name)


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
            "python -m stereobench.networks.keras_weights",
        ) from error
    return model, network, record["provenance"]


def covering(kind: str, wanted: tuple[int, int]) -> tuple[int, int]:
    """The least disparity range of a network's planes that holds the ``wanted`` one, px."""
    of = network_class(kind)
    first = wanted[0] // of.plane_px * of.plane_px
    step = of.plane_px * of.planes_divisor
    return first, first + -(-(wanted[1] - first) // step) * step
