"""How a network is trained, the state of a training between steps, and what a training leaves.

State: start, file, what is frozen, learning rate. Left are weights, curves, a figure, a summary.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import nn

from stereotruth.core.config.methods import Training
from stereotruth.core.config.section import Whole
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_file, write_table
from stereotruth.core.products.making import Marks, marks, refuse_replaced
from stereotruth.core.products.provenance import digest, file_sha256
from stereotruth.core.products.rasters import read_image
from stereotruth.tiles.stereo_dataset import StereoDataset

from .inference import load_network
from .training_pairs import LabelledPairs
from .weights import SavedNetwork, covering, load_weights, save_weights, scaling_of

log = logging.getLogger("stereotruth")
FORMAT = 1  # of the state
BETAS = (0.9, 0.999)

CURVE = ("epoch", "step", "learning_rate", "loss", "val_epe_px", "val_d1", "seconds")


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


@dataclass
class TrainingState:
    """Where a training is: ``step`` batches of ``epoch`` are done."""

    epoch: int = 0
    step: int = 0
    loss: float = 0.0  # summed over the epoch's steps
    seconds: float = 0.0
    best: float = float("inf")
    curve: list[dict[str, Any]] = field(default_factory=list)


def read_state(path: Path, key: str) -> dict[str, Any] | None:
    """The record of a training of this ``key``; None if there is none to go on from."""
    try:
        record = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        return None
    except Exception:  # another version's, or a damaged disk's: begin anew
        log.warning("%s: cannot be read, the training starts anew", path)
        return None
    if record.get("format") != FORMAT or record.get("key") != key:
        log.info("settings or data are others than before: the training starts anew")
        return None
    return record


def freeze_parts(network: nn.Module, frozen: Sequence[str]) -> list[nn.Module]:
    """Stop gradients of these parts, and return them."""
    parts = dict(network.named_children())
    if unknown := [name for name in frozen if name not in parts]:
        raise InputError(
            f"training.frozen: {type(network).__name__} has no part {unknown[0]!r}",
            remedy=f"take of {', '.join(parts)}",
        )
    for name in frozen:
        parts[name].requires_grad_(False)
    return [parts[name] for name in frozen]


def make_optimiser(network: nn.Module, learning_rate: float) -> torch.optim.Optimizer:
    """Adam; the squared norm of all kernels counts in the loss, as Keras' regularisers do it."""
    kernels = [p for p in network.parameters() if p.requires_grad and p.dim() > 1]
    others = [p for p in network.parameters() if p.requires_grad and p.dim() <= 1]
    groups = [
        {"params": kernels, "weight_decay": 2 * network.regularisation},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.Adam(groups, lr=learning_rate, betas=BETAS)


def model_of(kind: str, dataset: StereoDataset, training: TrainingSettings) -> SavedNetwork:
    """The network for a dataset: its range, its number of bands; else that of the first weights."""
    span = covering(kind, dataset.disparity_range)
    if training.initial_weights is None:
        image = read_image(dataset.pairs("train")[0].left)
        channels = 3 if image.ndim == 3 else 1
        return SavedNetwork(kind, span, channels, scaling_of(kind, channels))
    there, _ = load_network(training.initial_weights, kind)
    return replace(there, kind=kind, disparity_range=span)


def start(model: SavedNetwork, training: TrainingSettings) -> nn.Module:
    """The network that a training starts with: initial weights, or random ones from the seed."""
    torch.manual_seed(training.seed)
    network = model.build()
    path = training.initial_weights
    if path is None:
        return network
    there, other = load_network(path, model.kind)
    if (there.kind, there.channels) != (model.kind, model.channels):
        raise InputError(
            f"weights of {there.kind} with {there.channels} channels, "
            f"not of {model.kind} with {model.channels}",
            file=path,
            remedy="name weights of the same network in training.initial_weights",
        )
    network.load_state_dict(other.state_dict())
    return network


@dataclass(frozen=True)
class TrainingJob:
    """What every process of a training needs to know."""

    model: SavedNetwork
    training: TrainingSettings
    data: LabelledPairs
    held: LabelledPairs
    out: Path
    work: Path
    device: str
    processes: int

    @cached_property
    def files(self) -> list[Path]:
        """What is read: the files of all pairs, and initial weights."""
        pairs = (*self.data.pairs, *self.held.pairs)
        found = [Path(file) for p in pairs for file in (p.left, p.right, p.disparity)]
        initial = self.training.initial_weights
        return [*found, Path(initial)] if initial else found

    @cached_property
    def key(self) -> str:
        """Digest of all that the weights follow from, as it was when the training began."""
        return self._began[0]

    def refuse_changed(self) -> None:
        """Raise InputError if a file was written since the training began."""
        refuse_replaced(self._began[1])

    @cached_property
    def _began(self) -> tuple[str, Marks]:
        before = marks(self.files)
        with ThreadPoolExecutor() as pool:
            sums = list(pool.map(file_sha256, self.files))
        made_of = {
            "model": asdict(self.model),
            "training": self.training.content(),
            "files": dict(zip(map(str, self.files), sums)),
            "processes": self.processes,
        }
        return digest(made_of), before


def save_state(path: Path, record: Mapping[str, Any]) -> None:
    """Write a training's record, whole or not at all, on the disk itself."""
    with atomic_file(path) as scratch:
        torch.save(dict(record), scratch)
        with scratch.open("rb") as stream:
            os.fsync(stream.fileno())


def publish_training(job: TrainingJob, provenance: dict[str, Any]) -> dict[str, Any]:
    """Put the best weights and the curves to their final place."""
    record = read_state(job.work / "last.pt", job.key)
    if record is None or not record["state"]["curve"]:
        raise InputError(
            "no epoch was done", file=job.out, remedy="raise training.epochs or training.hours"
        )
    state = record["state"]
    model, network, best = load_weights(job.work / "best.pt")
    summary = {
        "model": asdict(model),
        "training": job.training.model_dump(),
        "parameters": sum(p.numel() for p in network.parameters()),
        "pairs": {"train": len(job.data.pairs), "val": len(job.held.pairs)},
        "steps": state["curve"][-1]["step"],
        "epochs": state["epoch"],
        "hours": round(state["seconds"] / 3600, 4),
        "device": device_name(torch.device(job.device)),
        "best": {k: best[k] for k in ("epoch", "val_epe_px", "val_d1")},
        "provenance": provenance,
    }
    job.out.mkdir(parents=True, exist_ok=True)
    save_weights(job.out / "best.pt", model, network, {**provenance, **best})
    write_table(job.out / "curves.csv", state["curve"], CURVE, line_end="\r\n")
    with atomic_file(job.out / "training.json") as scratch:
        scratch.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    _draw(state["curve"], job.out / "curves.png", f"{model.kind}: {job.out.name}")
    return summary


def device_name(device: torch.device) -> str:
    """What a person would call it."""
    if device.type == "cuda":
        return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name()}"
    return f"CPU, {torch.get_num_threads()} threads"


def _draw(curve: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    from matplotlib.figure import Figure

    from stereotruth.pages.pictures import save_figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    epochs = [row["epoch"] for row in curve]
    left.plot(epochs, [row["loss"] for row in curve], ".-", label="training loss")
    right.plot(epochs, [row["val_epe_px"] for row in curve], ".-", color="C1")
    for axes, what in ((left, "loss"), (right, "validation EPE, px")):
        axes.set(xlabel="epoch", ylabel=what, yscale="log")
        axes.grid(alpha=0.3, which="both")
    figure.suptitle(title)
    save_figure(path, figure)
