"""The stereo networks as methods of the benchmark: scaling of images, weight files, inference.

A weight file (``.pt``) holds a network's weights and what is needed to use them: kind, disparity
range, channels, scaling of the images, and where they come from.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import dask
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import InputError
from ..grid_store import replacing
from .hmsmnet import HMSMNet
from .layers import channels_last
from .psmnet import PSMNet
from .stereonet import StereoNet

log = logging.getLogger("stereotruth")

KINDS: dict[str, type[nn.Module]] = {"stereonet": StereoNet, "psmnet": PSMNet, "hmsmnet": HMSMNet}
SCALINGS = ("standardise", "us3d")
SAMPLES = 1 << 22  # pixels that a quantile is taken from
GREY = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R BT.601)


@dataclass(frozen=True)
class Model:
    """What a network is made of besides its weights.

    ``kind`` of :data:`KINDS`; ``disparity_range`` in px, max exclusive; ``channels`` of its images
    (1 or 3); ``scaling``: ``standardise`` (each image by its mean and standard deviation, as for
    WHU-Stereo) or ``us3d`` (8-bit values to -1 ... 1, blue first, as for US3D).
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
            return KINDS[self.kind](self.disparity_range, self.channels)
        except ValueError as error:
            raise InputError(
                f"{self.kind}: {error}", remedy=f"take {covering(self.kind, self.disparity_range)}"
            ) from error


def save_model(
    path: str | Path, model: Model, network: nn.Module, provenance: Mapping[str, Any]
) -> None:
    """Write a weight file in one step."""
    record = {
        "model": asdict(model),
        "weights": {name: value.cpu() for name, value in network.state_dict().items()},
        "provenance": dict(provenance),
    }
    with replacing(path) as scratch:
        torch.save(record, scratch)


def load_model(path: str | Path) -> tuple[Model, nn.Module, dict[str, Any]]:
    """The network of a weight file, and the file's provenance.

    Raises InputError if there is no such file, or it is another kind of file.
    """
    try:
        record = torch.load(path, map_location="cpu", weights_only=True)
        model = Model(
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
            "python -m stereotruth.matching.keras_weights",
        ) from error
    return model, network, record["provenance"]


class Scaling(NamedTuple):
    """What the blocks of both images must share, see :func:`image_statistics`."""

    left: tuple[float, float] | None
    right: tuple[float, float] | None


def image_statistics(image: Any, scaling: str) -> tuple[float, float] | None:
    """What the scaling of an image follows from (NumPy or Dask array of any size).

    ``standardise``: mean and standard deviation. ``us3d``: 0 and the grey value that becomes the
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
    image: NDArray[Any], model: Model, statistics: tuple[float, float] | None
) -> NDArray[np.float32]:
    """[H, W] or [H, W, 3] pixels -> [C, H, W] as the network takes them; nodata becomes 0.

    ``statistics`` of the whole image; None: of this one.
    """
    grey = image.ndim == 2
    first, second = statistics or image_statistics(image, model.scaling) or (0.0, 255.0)
    if model.scaling == "us3d":
        bands = np.repeat(image[..., None], 3, axis=2) if grey else image[..., ::-1]
        bands = np.minimum(bands.astype(np.float32) * np.float32(255 / second), 255)
        bands = bands / np.float32(127.5) - 1
        if model.channels == 1:
            bands = bands[..., ::-1] @ np.array(GREY, np.float32)[:, None]
        return np.ascontiguousarray(bands.transpose(2, 0, 1), dtype=np.float32)
    if not grey and model.channels == 1:
        image = image @ np.array(GREY, np.float32)
    out = (image.astype(np.float32) - np.float32(first)) / np.float32(second)
    out[image == 0] = 0
    if out.ndim == 2:
        return np.repeat(out[None], model.channels, axis=0)
    return np.ascontiguousarray(out.transpose(2, 0, 1))


def covering(kind: str, wanted: tuple[int, int]) -> tuple[int, int]:
    """The least disparity range of a network's planes that holds the ``wanted`` one, px."""
    of = KINDS[kind]
    first = wanted[0] // of.plane_px * of.plane_px
    step = of.plane_px * of.planes_divisor
    return first, first + -(-(wanted[1] - first) // step) * step


def padding(height: int, width: int, divisor: int) -> tuple[int, int]:
    """Rows and columns to add so that both sides are multiples of ``divisor``."""
    return -height % divisor, -width % divisor


def choose_device(wanted: str | None) -> torch.device:
    """The device of that name; None: a GPU if there is one.

    Raises InputError if it is not to be had.
    """
    name = wanted or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.zeros(1, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"device {name}: {str(error).splitlines()[0]}", remedy="set device to null, or cpu"
        ) from error


PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16, "float16": torch.float16}


def precision_of(wanted: str | None, device: torch.device) -> str:
    """The name of a precision; None: float32 on a CPU, mixed with bfloat16 on a GPU."""
    return wanted or ("bfloat16" if device.type == "cuda" else "float32")


def mixed(precision: str, device: torch.device) -> Any:
    """The context in which a network computes at that precision."""
    kind = PRECISIONS[precision]
    return nullcontext() if kind is None else torch.autocast(device.type, kind)


class NetworkMethod:
    """A network with its weights as a method; see :class:`methods.Matcher`."""

    def __init__(
        self, model: Model, network: nn.Module, device: torch.device, precision: str
    ) -> None:
        self.model, self.device, self.precision = model, device, precision
        self.network = channels_last(network.eval().to(device))
        self.margin_px = network.margin_px
        self._range = model.disparity_range

    def _look_for(self, wanted: tuple[int, int]) -> None:
        """Set the network's range."""
        span = covering(self.model.kind, wanted)
        if span != self._range:
            if span != self.model.disparity_range:
                log.info(
                    "%s was trained for disparities of %d to %d px, and looks for %d to %d px",
                    self.model.kind,
                    *self.model.disparity_range,
                    *span,
                )
            self.network.set_range(span)
            self._range = span

    def scaling(self, left: Any, right: Any) -> Scaling:
        """Statistics of whole images (NumPy or Dask) that all their parts must share."""
        return Scaling(*(image_statistics(image, self.model.scaling) for image in (left, right)))

    def __call__(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: tuple[int, int],
        scaling: Scaling | None = None,
    ) -> NDArray[np.float32]:
        """Disparity [H, W] of the left image, px; NaN where the left pixel is nodata.

        A ``disparity_range`` other than that of the training is taken, widened to the
        network's planes.
        """
        self._look_for(disparity_range)
        height, width = left.shape[:2]
        rows, cols = padding(height, width, self.network.divisor)
        both = []
        for image, statistics in zip((left, right), scaling or (None, None)):
            tensor = torch.from_numpy(scaled(image, self.model, statistics))[None]
            both.append(F.pad(tensor, (0, cols, 0, rows)).to(self.device))
        with torch.inference_mode(), mixed(self.precision, self.device):
            found: Tensor = self.network(*both)[-1]
        disparity = found[0, :height, :width].float().cpu().numpy()
        seen = (left if left.ndim == 2 else left.any(axis=2)) != 0
        return np.where(seen, disparity, np.float32(np.nan))


def network_method(kind: str, settings: Mapping[str, Any], workers: int = 0) -> NetworkMethod:
    """The method of a configuration entry: ``weights`` (a .pt, or Keras' .h5), ``device``,
    ``precision``, and for .h5 ``scaling``; ``workers`` threads on a CPU (0: all cores).

    Raises InputError if the weights are missing or those of another network.
    """
    path = settings.get("weights")
    if path is None:
        raise InputError(
            f"{kind}: no weights", remedy="train it, or name a file in benchmark.methods"
        )
    if is_keras(path):
        from .keras_weights import read_keras

        model, network = read_keras(path, kind, settings.get("scaling"))
    else:
        model, network, _ = load_model(path)
        if model.kind != kind:
            raise InputError(
                f"weights of {model.kind}, not of {kind}", file=path, remedy="correct the kind"
            )
    device = choose_device(settings.get("device"))
    if device.type == "cpu" and workers:
        torch.set_num_threads(workers)
    return NetworkMethod(model, network, device, precision_of(settings.get("precision"), device))


def is_keras(path: str | Path) -> bool:
    """Whether a weight file is one of Keras, by its name."""
    return Path(path).suffix in (".h5", ".hdf5")
