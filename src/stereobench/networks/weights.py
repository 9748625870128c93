"""Weight files of networks, those of Keras too; images as a network takes them.

A weight file (``.pt``) holds a network's weights and what is needed to use them: kind, disparity
range, channels, scaling of the images, and where they come from.

In files of Keras (``.h5``), names number the layers in the order of their making, which differs
from file to file; what is stable is the order in which a network calls them. So weights are taken
by order: for each part of the network first the trainable ones (kernel, then bias or scale and
shift), then the statistics of batch normalisation. Every shape must fit.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import dask
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from stereotruth.core.errors import InputError, install_extra
from stereotruth.core.products.files import atomic_file

from ..methods.kinds import KINDS
from .layers import TRAINED

SAMPLES = 1 << 22  # pixels that a quantile is taken from
GREY = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R BT.601)

Arrays = list[NDArray[np.float32]]
MOST_BYTES = 2 << 30  # of all arrays of a file, as they are in memory
MOST_NAMES = 20_000  # of layers and arrays
DEEPEST = 20  # groups in each other
REMEDY = "name an .h5 file that Keras has saved (weights or model), from somebody whom you trust"


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
            remedy="train the network again, or name weights of Keras (.h5)",
        ) from error
    return model, network, record["provenance"]


def covering(kind: str, wanted: tuple[int, int]) -> tuple[int, int]:
    """The least disparity range of a network's planes that holds the ``wanted`` one, px."""
    of = network_class(kind)
    first = wanted[0] // of.plane_px * of.plane_px
    step = of.plane_px * of.planes_divisor
    return first, first + -(-(wanted[1] - first) // step) * step


def read_weights(path: str | Path) -> list[Arrays]:
    """The weight arrays of each layer of the network that has any, in the file's order.

    Raises InputError if h5py is missing, if the file is none of Keras' weight files, or if it
    leads to other files, in a circle, or to more than MOST_BYTES.
    """
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            "h5py is needed to read Keras weights",
            file=path,
            remedy=install_extra("networks"),
        ) from error
    try:
        with h5py.File(path, "r") as file:
            top = _inside(file, "model_weights", path) if "model_weights" in file else file
            layers = [_inside(top, name, path) for name in _names(top, "layer_names", path)]
            places = [
                [_inside(layer, name, path) for name in _names(layer, "weight_names", path)]
                for layer in layers
            ]
            _refuse_large([place for of in places for place in of], path)
            return [[np.asarray(place) for place in of] for of in places if of]
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("no such weight file", file=path, remedy=REMEDY) from None
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise InputError(
            f"not a weight file of Keras ({error})", file=path, remedy=REMEDY
        ) from error


def _names(group: Any, key: str, path: str | Path) -> Iterator[str]:
    """The names that an attribute lists."""
    listed = np.atleast_1d(group.attrs[key])
    if listed.size > MOST_NAMES:
        raise InputError(f"{listed.size} names in {key}", file=path, remedy=REMEDY)
    return (name.decode() if isinstance(name, bytes) else str(name) for name in listed.ravel())


def _inside(group: Any, name: str, path: str | Path) -> Any:
    """What a group holds under a name, by hard links alone. Raises InputError for other links."""
    import h5py

    parts = [part for part in name.split("/") if part]
    if len(parts) > DEEPEST:
        raise InputError(f"{len(parts)} groups in each other", file=path, remedy=REMEDY)
    for part in parts:
        link = group.get(part, getlink=True)
        if isinstance(link, (h5py.SoftLink, h5py.ExternalLink)):
            kind = "another file" if isinstance(link, h5py.ExternalLink) else "another place"
            raise InputError(f"{name[:80]!r} is a link to {kind}", file=path, remedy=REMEDY)
        group = group[part]
    return group


def _refuse_large(places: list[Any], path: str | Path) -> None:
    """Raise InputError if arrays are not of plain numbers in this file, or too large."""
    total = 0
    for place in places:
        if place.external or place.is_virtual:
            raise InputError(
                f"{place.name[:80]!r} has its values in other files", file=path, remedy=REMEDY
            )
        if place.dtype.kind not in "fiu":
            raise InputError(f"{place.name[:80]!r} holds no numbers", file=path, remedy=REMEDY)
        total += math.prod(place.shape) * place.dtype.itemsize
    if total > MOST_BYTES or len(places) > MOST_NAMES:
        raise InputError(
            f"{len(places)} arrays of {total / 1e9:.1f} GB are no network that is known here",
            file=path,
            remedy=REMEDY,
        )


def _parts(network: nn.Module) -> Iterator[nn.Module]:
    """What Keras counts as the network's layers: lists of parts are taken one by one."""
    for child in network.children():
        if isinstance(child, nn.ModuleList):
            yield from child
        elif any(True for _ in child.parameters()):
            yield child


def _slots(part: nn.Module) -> list[tuple[torch.Tensor, tuple[int, ...]]]:
    """The tensors of a part in Keras' order, with the axes of Keras that make up theirs."""
    trained: list[tuple[torch.Tensor, tuple[int, ...]]] = []
    statistics: list[tuple[torch.Tensor, tuple[int, ...]]] = []
    for module in part.modules():
        if isinstance(module, TRAINED):
            n = module.weight.dim()
            # kernels are [space..., in, out] there; transposed ones [space..., out, in], so that
            # the same axes serve both; those of each channel by itself [space..., in, 1]
            single = getattr(module, "groups", 1) > 1
            ends = (n - 2, n - 1) if single else (n - 1, n - 2)
            trained.append((module.weight, (*ends, *range(n - 2))))
            if module.bias is not None:
                trained.append((module.bias, (0,)))
        elif isinstance(module, (nn.BatchNorm2d, nn.BatchNorm3d)):
            trained += [(module.weight, (0,)), (module.bias, (0,))]
            statistics += [(module.running_mean, (0,)), (module.running_var, (0,))]
    return trained + statistics


def load_keras(network: nn.Module, path: str | Path) -> None:
    """Set a network's weights to those of a Keras file.

    Raises InputError, naming the place, if the file does not hold this network's weights.
    """
    parts, layers = list(_parts(network)), read_weights(path)
    remedy = "check the kind of network and the number of its channels"
    if len(parts) != len(layers):
        raise InputError(
            f"{len(layers)} layers with weights, {type(network).__name__} has {len(parts)}",
            file=path,
            remedy=remedy,
        )
    for number, (part, arrays) in enumerate(zip(parts, layers)):
        slots = _slots(part)
        found = [array.shape for array in arrays]
        wanted = []
        for tensor, axes in slots:
            shape = [0] * len(axes)
            for axis, size in zip(axes, tensor.shape):
                shape[axis] = size
            wanted.append(tuple(shape))
        if found != wanted:
            where = next((k for k, pair in enumerate(zip(found, wanted)) if pair[0] != pair[1]), -1)
            raise InputError(
                f"layer {number}: {len(found)} arrays where {type(network).__name__} has "
                f"{len(wanted)}; the first that differs is number {where}",
                file=path,
                remedy=remedy,
            )
        with torch.no_grad():
            for (tensor, axes), array in zip(slots, arrays):
                tensor.copy_(torch.from_numpy(np.ascontiguousarray(array.transpose(axes))))


def read_keras(
    path: str | Path,
    kind: str,
    scaling: str | None = None,
    disparity_range: tuple[int, int] = (-128, 64),
) -> tuple[SavedNetwork, nn.Module]:
    """A network with the weights of a Keras file, whose first kernel says how many channels.

    ``scaling``: None: that of the kind (:func:`.weights.scaling_of`).
    Raises InputError as :func:`load_keras` does.
    """
    first = next((of[0] for of in read_weights(path)), None)
    if first is None:
        raise InputError("no weights", file=path, remedy=REMEDY)
    channels = 3 if first.ndim == 4 and first.shape[2] % 3 == 0 else 1  # of one image or of both
    scaling = scaling or scaling_of(kind, channels)
    model = SavedNetwork(kind, disparity_range, channels, scaling)
    network = model.build()
    load_keras(network, path)
    return model, network
