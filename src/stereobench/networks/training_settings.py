"""How a network is trained."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from stereotruth.core.config.methods import Training
from stereotruth.core.config.section import Whole
from stereotruth.core.errors import InputError

if TYPE_CHECKING:
    from torch import nn


class TrainingSettings(Training):
    """How a network is trained, with what does not stand in the section training."""

    threads: Whole = 0
    seed: Whole = 0

    def on(self, threads: int) -> TrainingSettings:
        """The same, with so many threads on a CPU where the configuration leaves that open."""
        return self.model_copy(update={"threads": self.threads or threads})

    def content(self) -> dict[str, Any]:
        """What the weights follow from: all but how long and where the work is done."""
        left_out = ("epochs", "hours", "threads", "loader_workers", "checkpoint_minutes", "device")
        return self.model_dump(exclude=set(left_out))


def check_crop(network: nn.Module, crop: tuple[int, int] | None) -> None:
    """InputError unless the sides of ``crop`` fit the network."""
    if crop and any(side % network.divisor for side in crop):
        raise InputError(
            f"training.crop_px {list(crop)}: no multiples of {network.divisor} px",
            remedy=f"{type(network).__name__} needs them",
        )
