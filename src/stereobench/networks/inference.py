"""The stereo networks as methods of the benchmark: device, precision, range, uncertainty.

``uncertainty`` of an entry states a standard uncertainty: by the ``entropy`` of the last softmax
(the standard deviation of a uniform distribution as wide as the planes that it is spread over, see
:func:`.layers.perplexity`), or by ``flips``, the spread (:func:`..methods.matcher.spread`) between
the disparities of the pair and of the pair upside down.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from stereotruth.core.errors import InputError

from ..methods.matcher import spread
from .layers import channels_last, perplexity, resize
from .weights import (
    SavedNetwork,
    Scaling,
    covering,
    image_statistics,
    load_weights,
    read_keras,
    scaled,
)

log = logging.getLogger("stereotruth")

UNCERTAINTIES = (None, "entropy", "flips")
PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16, "float16": torch.float16}


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


def precision_of(wanted: str | None, device: torch.device, on_gpu: str = "float32") -> str:
    """The name of a precision; None: float32 on a CPU, ``on_gpu`` on a GPU.

    float32 on a CPU that does not have what is wanted: there it would take 40 times as long.
    """
    if wanted and device.type == "cpu" and not _is_computed(wanted):
        log.warning("this processor computes no %s: float32 is taken, which is faster", wanted)
        return "float32"
    return wanted or (on_gpu if device.type == "cuda" else "float32")


def _is_computed(precision: str) -> bool:
    """Whether this processor has the numbers of a precision, as far as PyTorch's build can tell."""
    asked = {"bfloat16": "_is_mkldnn_bf16_supported", "float16": "_is_mkldnn_fp16_supported"}
    return precision not in asked or getattr(torch.ops.mkldnn, asked[precision], lambda: True)()


def mixed(precision: str, device: torch.device) -> Any:
    """The context in which a network computes at that precision.

    float32 on a GPU is without TF32, which rounds what convolutions read to 11 bits.
    """
    if (kind := PRECISIONS[precision]) is not None:
        return torch.autocast(device.type, kind)
    if device.type != "cuda":
        return nullcontext()
    return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)


class NetworkMethod:
    """A network with its weights as a method; see :class:`stereobench.methods.matcher.Matcher`."""

    def __init__(
        self,
        model: SavedNetwork,
        network: nn.Module,
        device: torch.device,
        precision: str,
        uncertainty: str | None = None,
    ) -> None:
        self._uncertainty = uncertainty
        self._planes: Tensor | None = None  # that the last softmax was spread over
        self.model, self.device, self.precision = model, device, precision
        self.network = channels_last(network.eval().to(device))
        self.margin_px = network.margin_px
        if uncertainty == "entropy":
            network.expected.register_forward_hook(self._seen)
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
        return self._found(left, right, disparity_range, scaling)[0]

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: tuple[int, int],
        scaling: Scaling | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The disparity, and its standard uncertainty [H, W] px if one is asked for."""
        found, sigma = self._found(left, right, disparity_range, scaling)
        if self._uncertainty == "flips":
            turned = (np.ascontiguousarray(image[::-1]) for image in (left, right))
            again, _ = self._found(*turned, disparity_range, scaling)
            sigma = spread(found, again[::-1])
        return found, sigma

    def _seen(self, part: nn.Module, given: tuple[Any, ...], found: Tensor) -> None:
        self._planes = perplexity(given[0])

    def _found(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: tuple[int, int],
        scaling: Scaling | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
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
        sigma = None
        if self._planes is not None:
            # a plane is as wide as a pixel of the volume
            wide = self._planes * (both[0].shape[2] / self._planes.shape[1])
            full = resize(wide[:, None], both[0].shape[2:])[0, 0, :height, :width].cpu().numpy()
            sigma = np.where(seen, full / np.float32(math.sqrt(12)), np.float32(np.nan))
        return np.where(seen, disparity, np.float32(np.nan)), sigma


def make(name: str, kind: str, settings: Mapping[str, Any], workers: int) -> NetworkMethod:
    """The method of a configuration entry: ``weights`` (a .pt, or Keras' .h5), ``device``,
    ``precision``, ``uncertainty``, for .h5 ``scaling``; ``workers`` threads on a CPU (0: all).

    Raises InputError if the weights are missing or those of another network.
    """
    path = settings.get("weights")
    if path is None:
        raise InputError(
            f"{kind}: no weights", remedy="train it, or name a file in benchmark.methods"
        )
    model, network = load_network(path, kind, settings.get("scaling"))
    if model.kind != kind:
        raise InputError(
            f"weights of {model.kind}, not of {kind}", file=path, remedy="correct the kind"
        )
    if (uncertainty := settings.get("uncertainty")) not in UNCERTAINTIES:
        raise InputError(
            f"method {name!r}: no uncertainty {uncertainty!r} of a network",
            remedy=f"take one of {', '.join(filter(None, UNCERTAINTIES))}, or null",
        )
    if uncertainty == "entropy" and not hasattr(network, "expected"):
        raise InputError(
            f"method {name!r}: {kind} has no softmax whose entropy would be an uncertainty",
            remedy="take uncertainty: flips, or null",
        )
    device = choose_device(settings.get("device"))
    if device.type == "cpu" and workers:
        torch.set_num_threads(workers)
    precision = precision_of(settings.get("precision"), device)
    return NetworkMethod(model, network, device, precision, uncertainty)


def load_network(
    path: str | Path, kind: str, scaling: str | None = None
) -> tuple[SavedNetwork, nn.Module]:
    """The network of a file, which tells its kind itself; one of Keras is taken for ``kind``.

    ``scaling``: of the images for a file of Keras, see :func:`.weights.read_keras`.
    Raises InputError if there is no such file, or it does not hold the network's weights.
    """
    if Path(path).suffix in (".h5", ".hdf5"):
        return read_keras(path, kind, scaling)
    model, network, _ = load_weights(path)
    return model, network
