"""How a network is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from torch import nn

from ...errors import InputError
from .training_pairs import Augmentation


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained; the defaults are the paper's.

    ``crop_px``: rows and columns of the windows trained on, null: whole pairs; ``crops_per_pair``
    in each epoch. ``initial_weights``: a .pt or Keras' .h5 to start from; ``frozen``: parts of the
    network that keep them (such as ``features``), with their batch statistics. ``hours``: of
    training at most, all runs together; it ends after the epoch in which they are over.
    ``processes``: null: one for each GPU. ``loader_workers``: processes that read pairs.
    """

    epochs: int = 120
    batch_size: int = 1
    learning_rate: float = 1e-3
    halve_every_epochs: int = 10
    crop_px: tuple[int, int] | None = None
    crops_per_pair: int = 1
    augmentation: Augmentation = field(default_factory=Augmentation)
    initial_weights: str | None = None
    frozen: tuple[str, ...] = ()
    device: str | None = None
    precision: str | None = None
    threads: int = 0
    processes: int | None = None
    loader_workers: int = 0
    checkpoint_minutes: float = 5.0
    hours: float | None = None
    seed: int = 0

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
        crop = merged.get("crop_px")
        merged["crop_px"] = tuple(crop) if crop else None
        merged["frozen"] = tuple(merged.get("frozen") or ())
        if not isinstance(merged.get("augmentation"), Augmentation):
            merged["augmentation"] = Augmentation(**(merged.get("augmentation") or {}))
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
