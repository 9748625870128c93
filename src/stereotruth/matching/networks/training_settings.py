"""How a network is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from ...errors import InputError
from ...settings import Flag, Number, Share, Text, Unit, Whole, settings

if TYPE_CHECKING:
    from torch import nn

Count = Annotated[Whole, Field(ge=1)]
NotNegative = Annotated[Number, Field(ge=0)]


@settings
class Augmentation:
    """Random changes of training pairs; as it stands, none (the paper uses none)."""

    flip_rows: Flag = False
    """upside down, every other time"""

    contrast: Annotated[NotNegative, Unit("standard deviation")] = 0
    """of the logarithm of a random factor on the contrast of each image by itself"""

    brightness: Annotated[NotNegative, Unit("standard deviations of the image")] = 0
    """of a random offset to each image by itself"""

    noise: Annotated[NotNegative, Unit("standard deviations of the image")] = 0
    """of each pixel of both images, at most: each pair has its own, from 0 to this"""

    blur: Annotated[Share, Unit("share of the pairs")] = 0
    """one image, left or right, out of focus, by up to 2.3 px"""

    shadows: Annotated[Share, Unit("share of the pairs")] = 0
    """patches of shadow in one image, as where the sun has moved"""

    haze: Annotated[Share, Unit("share of the pairs")] = 0
    """less contrast and more light in one image, by places"""

    @property
    def faults(self) -> dict[str, float]:
        """Chances of the faults that images themselves have, by name of image_faults.FAULTS."""
        return {"blur": self.blur, "shadows": self.shadows, "haze": self.haze}


@settings
class Training:
    """The configuration's section training; the defaults are the paper's."""

    epochs: Count = 120
    """passes over all pairs"""

    batch_size: Annotated[Count, Unit("pairs")] = 1
    """of each process"""

    learning_rate: Annotated[Number, Field(gt=0)] = 0.001
    """of Adam"""

    halve_every_epochs: Annotated[Count, Unit("epochs")] = 10
    """after so many the learning rate is halved"""

    crop_px: Annotated[
        tuple[Annotated[Whole, Field(ge=8)], Annotated[Whole, Field(ge=8)]] | None, Unit("px, px")
    ] = None
    """rows and columns of random windows that are trained on, multiples of 8 (StereoNet,
    DenseMapNet), 64 (HMSM-Net), 256 (PSM-Net); null: whole tiles"""

    crops_per_pair: Annotated[Count, Unit("windows")] = 1
    """of each pair in an epoch"""

    augmentation: Augmentation = field(default_factory=Augmentation)
    """random changes of the training pairs; none as it stands:"""

    initial_weights: Annotated[Text | None, Unit("file")] = None
    """weights to start from (fine-tuning): a `.pt` that rule `train` made, also of another dataset
    (`results/train/us3d/stereonet/best.pt` is made if need be), or Keras' `.h5`"""

    frozen: Annotated[tuple[Text, ...], Unit("names")] = ()
    """parts of the network that keep the initial weights, such as `features`, with their batch
    statistics"""

    hours: Annotated[Annotated[Number, Field(gt=0)] | None, Unit("h")] = None
    """of training at most, all runs together; it ends after the epoch in which they are over"""

    device: Annotated[Text | None, Unit("cpu, cuda or another of PyTorch")] = None
    """null: the GPUs that there are"""

    precision: Literal["float32", "bfloat16", "float16"] | None = None
    """null: mixed with bfloat16 on a GPU, float32 on a CPU; processors with matrix units (AMX) are
    three times as fast with `bfloat16`, those that have no such numbers take float32"""

    processes: Count | None = None
    """that share each step; null: one for each GPU"""

    loader_workers: Annotated[Whole, Field(ge=0), Unit("processes")] = 0
    """that read tiles beside the training"""

    checkpoint_minutes: Annotated[NotNegative, Unit("min")] = 5
    """a killed training goes on from its last checkpoint, at the latest from the last epoch"""


@settings
class TrainingSettings(Training):
    """How a network is trained, with what does not stand in the section training."""

    threads: Whole = 0
    seed: Whole = 0

    @classmethod
    def of(cls, *settings: Mapping[str, Any]) -> TrainingSettings:
        """From the configuration; later mappings have precedence.

        Raises InputError for a key that there is not.
        """
        merged: dict[str, Any] = {}
        for mapping in settings:
            merged.update(mapping)
        known = {f.name for f in fields(cls)}
        if unknown := set(merged) - known:
            raise InputError(
                f"training: unknown keys {', '.join(sorted(unknown))}",
                remedy=f"take of {', '.join(sorted(known))}",
            )
        return cls(**merged)

    def on(self, threads: int) -> TrainingSettings:
        """The same, with so many threads on a CPU where the configuration leaves that open."""
        return replace(self, threads=self.threads or threads)

    def content(self) -> dict[str, Any]:
        """What the weights follow from: all but how long and where the work is done."""
        left_out = ("epochs", "hours", "threads", "loader_workers", "checkpoint_minutes", "device")
        return {k: v for k, v in asdict(self).items() if k not in left_out}


def check_crop(network: nn.Module, crop: tuple[int, int] | None) -> None:
    """InputError unless the sides of ``crop`` fit the network."""
    if crop and any(side % network.divisor for side in crop):
        raise InputError(
            f"training.crop_px {list(crop)}: no multiples of {network.divisor} px",
            remedy=f"{type(network).__name__} needs them",
        )
