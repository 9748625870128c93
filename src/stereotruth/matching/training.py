"""Training and fine-tuning of the stereo networks (paper, section V).

Smooth L1 over the labelled pixels of each output, Adam, learning rate halved every so many epochs,
the weights that do best on the validation pairs are kept.

The state of a training lies in a hidden folder beside its product (``.<name>.work/last.pt``,
written whole): weights, optimiser, place in the epoch. A killed training goes on from there, and
on one CPU ends with the weights of an undisturbed one; with other settings or data it starts anew.
"""

from __future__ import annotations

import csv
import json
import logging
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from ..errors import InputError
from ..grid_store import replacing
from ..locking import exclusive
from ..provenance import digest, file_sha256
from ..runlog import progress
from .data import Augmentation, LabelledPairs
from .keras_weights import load_keras, read_keras
from .layers import channels_last
from .layouts import StereoDataset, read_image
from .networks import (
    Model,
    choose_device,
    covering,
    is_keras,
    load_model,
    mixed,
    padding,
    precision_of,
    save_model,
)

log = logging.getLogger("stereotruth")

FORMAT = 1  # of the state
BETAS = (0.9, 0.999)
CURVE = ("epoch", "step", "learning_rate", "loss", "val_epe_px", "val_d1", "seconds")


@dataclass(frozen=True)
class Training:
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
    def of(cls, *settings: Mapping[str, Any]) -> Training:
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

    def on(self, threads: int) -> Training:
        """The same, with so many threads on a CPU where the configuration leaves that open."""
        return replace(self, threads=self.threads or threads)

    def content(self) -> dict[str, Any]:
        """What the weights follow from: all but how long and where the work is done."""
        left_out = ("epochs", "hours", "threads", "loader_workers", "checkpoint_minutes", "device")
        return {k: v for k, v in asdict(self).items() if k not in left_out}


# ------------------------------------------------------------------------------------- the loss


def loss_of(outputs: Sequence[Tensor], disparity: Tensor, weights: Sequence[float]) -> Tensor:
    """Weighted sum over the outputs of the mean smooth L1 over labelled pixels.

    ``outputs``: [N, h, w], of the labels' size or a whole part of it and then in their own pixels;
    ``disparity``: [N, H, W] px, NaN unlabelled. 0 without any label.
    """
    valid = torch.isfinite(disparity)
    known = torch.where(valid, disparity, 0.0)
    total = disparity.new_zeros(())
    for output, weight in zip(outputs, weights):
        scale = disparity.shape[1] // output.shape[1]
        target, where = known, valid
        if scale > 1:  # means over the labelled pixels only
            share = F.avg_pool2d(valid.float().unsqueeze(1), scale).squeeze(1)
            where = share > 0
            pooled = F.avg_pool2d(known.unsqueeze(1), scale).squeeze(1)
            target = pooled / share.clamp_min(1e-6) / scale
        if where.any():
            error = F.smooth_l1_loss(output.float()[where], target[where])
            total = total + weight * error
    return total


# ------------------------------------------------------------------------------------ the state


@dataclass
class _State:
    """Where a training is: ``step`` batches of ``epoch`` are done."""

    epoch: int = 0
    step: int = 0
    loss: float = 0.0  # summed over the epoch's steps
    seconds: float = 0.0
    best: float = float("inf")
    curve: list[dict[str, Any]] = field(default_factory=list)


def _read_state(path: Path, key: str) -> dict[str, Any] | None:
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


def _learning_rate(training: Training, epoch: int) -> float:
    return training.learning_rate * 0.5 ** (epoch // training.halve_every_epochs)


def _freeze(network: nn.Module, frozen: Sequence[str]) -> list[nn.Module]:
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


def _set_training(network: nn.Module, frozen: Sequence[nn.Module]) -> None:
    network.train()
    for part in frozen:  # with the statistics that its weights were trained with
        part.eval()


def _optimiser(network: nn.Module, learning_rate: float) -> torch.optim.Optimizer:
    """Adam; the squared norm of all kernels counts in the loss, as Keras' regularisers do it."""
    kernels = [p for p in network.parameters() if p.requires_grad and p.dim() > 1]
    others = [p for p in network.parameters() if p.requires_grad and p.dim() <= 1]
    groups = [
        {"params": kernels, "weight_decay": 2 * network.regularisation},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.Adam(groups, lr=learning_rate, betas=BETAS)


def model_of(kind: str, dataset: StereoDataset, training: Training) -> Model:
    """The network for a dataset: its range, its number of bands; else that of the first weights."""
    span = covering(kind, dataset.disparity_range)
    if training.initial_weights is None:
        image = read_image(dataset.pairs("train")[0].left)
        colour = image.ndim == 3
        return Model(kind, span, 3 if colour else 1, "us3d" if colour else "standardise")
    if is_keras(training.initial_weights):
        there, _ = read_keras(training.initial_weights, kind)
    else:
        there, _, _ = load_model(training.initial_weights)
    return replace(there, kind=kind, disparity_range=span)


def start(model: Model, training: Training) -> nn.Module:
    """The network that a training starts with: initial weights, or random ones from the seed."""
    torch.manual_seed(training.seed)
    network = model.build()
    path = training.initial_weights
    if path is None:
        return network
    if is_keras(path):
        load_keras(network, path)
        return network
    there, other, _ = load_model(path)
    if (there.kind, there.channels) != (model.kind, model.channels):
        raise InputError(
            f"weights of {there.kind} with {there.channels} channels, "
            f"not of {model.kind} with {model.channels}",
            file=path,
            remedy="name weights of the same network in training.initial_weights",
        )
    network.load_state_dict(other.state_dict())
    return network


# --------------------------------------------------------------------------------- the training


def train(
    model: Model,
    dataset: StereoDataset,
    out: str | Path,
    training: Training,
    provenance: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Train a network on a dataset's ``train`` pairs and keep the best on its ``val`` pairs.

    Writes into the folder ``out``: ``best.pt``, ``curves.csv``, ``curves.png``, ``training.json``.
    Returns what the last of them holds.

    Raises InputError if there are no pairs to train or validate on, if crops do not fit the
    network or the pairs, or if the loss is no number any more.
    """
    network = start(model, training)
    _check_crop(network, training.crop_px)
    data = LabelledPairs.of(
        dataset,
        "train",
        model,
        crop_px=training.crop_px,
        crops_per_pair=training.crops_per_pair,
        augmentation=training.augmentation,
        seed=training.seed,
    )
    held = LabelledPairs.of(dataset, "val", model)
    device = choose_device(training.device)
    processes = training.processes
    if processes is None:
        processes = max(torch.cuda.device_count(), 1) if device.type == "cuda" else 1
    out = Path(out)
    work = out.with_name(f".{out.name}.work")
    work.mkdir(parents=True, exist_ok=True)
    job = _Job(model, training, data, held, out, work, device.type, processes)
    with exclusive(out):
        if processes > 1:
            rendezvous = work / "rendezvous"
            rendezvous.unlink(missing_ok=True)
            torch.multiprocessing.spawn(_run_one, (job, rendezvous), nprocs=processes)
        else:
            _run(job, 0, network, device)
        return _publish(job, dict(provenance or {}))


def _check_crop(network: nn.Module, crop: tuple[int, int] | None) -> None:
    if crop and any(side % network.divisor for side in crop):
        raise InputError(
            f"training.crop_px {list(crop)}: no multiples of {network.divisor} px",
            remedy=f"{type(network).__name__} needs them",
        )


@dataclass(frozen=True)
class _Job:
    """What every process of a training needs to know."""

    model: Model
    training: Training
    data: LabelledPairs
    held: LabelledPairs
    out: Path
    work: Path
    device: str
    processes: int

    @cached_property
    def key(self) -> str:
        """Digest of all that the weights follow from, as it was when the training began."""
        files = {
            pair.name: [str(pair.left), str(pair.right), str(pair.disparity)]
            for pair in (*self.data.pairs, *self.held.pairs)
        }
        initial = self.training.initial_weights
        return digest(
            {
                "model": asdict(self.model),
                "training": self.training.content(),
                "initial": file_sha256(initial) if initial else None,
                "files": files,
                "processes": self.processes,
            }
        )


def _run_one(rank: int, job: _Job, rendezvous: Path) -> None:
    """One of several processes, each with a GPU of its own (or all on the CPU)."""
    logging.basicConfig(level=logging.INFO if rank == 0 else logging.ERROR, format="%(message)s")
    device = torch.device(job.device, rank) if job.device == "cuda" else torch.device(job.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group(
        "nccl" if device.type == "cuda" else "gloo",
        init_method=f"file://{rendezvous.absolute()}",
        rank=rank,
        world_size=job.processes,
    )
    try:
        _run(job, rank, start(job.model, job.training), device)
    finally:
        dist.destroy_process_group()


def _run(job: _Job, rank: int, network: nn.Module, device: torch.device) -> None:
    """Train until all epochs are done or the hours are over."""
    training, alone = job.training, job.processes == 1
    if training.threads:
        torch.set_num_threads(training.threads)
    network = channels_last(network.to(device))
    frozen = _freeze(network, training.frozen)
    if not alone and device.type == "cuda":
        network = nn.SyncBatchNorm.convert_sync_batchnorm(network)
    optimiser = _optimiser(network, training.learning_rate)
    state, last = _State(), job.work / "last.pt"
    key = job.key
    if (record := _read_state(last, key)) is not None:
        network.load_state_dict(record["weights"])
        optimiser.load_state_dict(record["optimiser"])
        state = _State(**record["state"])
        log.info("goes on in epoch %d, after %d steps of it", state.epoch + 1, state.step)
    shared = network
    if not alone:
        ids = [device.index] if device.type == "cuda" else None
        shared = nn.parallel.DistributedDataParallel(network, device_ids=ids)
    precision = precision_of(training.precision, device)
    scaler = torch.amp.GradScaler(device.type, enabled=precision == "float16")

    def keep() -> None:
        if rank == 0:
            _save(
                last,
                {
                    "format": FORMAT,
                    "key": key,
                    "weights": network.state_dict(),
                    "optimiser": optimiser.state_dict(),
                    "state": asdict(state),
                },
            )

    while state.epoch < training.epochs and not _over(training, state):
        for group in optimiser.param_groups:
            group["lr"] = _learning_rate(training, state.epoch)
        _set_training(network, frozen)
        began = saved = time.monotonic()
        steps = _steps(job, state.epoch)
        before = state.seconds
        for left, right, disparity in _shown(job, rank, state, steps[state.step :]):
            left, right, disparity = (t.to(device) for t in (left, right, disparity))
            optimiser.zero_grad(set_to_none=True)
            with mixed(precision, device):
                outputs = shared(left, right)
            loss = loss_of(outputs, disparity, network.loss_weights)
            if loss.requires_grad:
                scaler.scale(loss).backward()
                scaler.step(optimiser)
                scaler.update()
            value = float(loss.detach())
            if not np.isfinite(value):
                raise InputError(
                    f"the loss is {value} in epoch {state.epoch + 1}, step {state.step + 1}",
                    file=last,
                    remedy="lower training.learning_rate, or set training.precision to float32",
                )
            state.loss += value
            state.step += 1
            state.seconds = before + time.monotonic() - began
            if time.monotonic() - saved > 60 * training.checkpoint_minutes:
                keep()
                saved = time.monotonic()
        _end_epoch(job, rank, network, device, precision, optimiser, state, len(steps))
        state.seconds = before + time.monotonic() - began
        if not alone:
            dist.barrier()
        keep()


def _shown(
    job: _Job, rank: int, state: _State, steps: Sequence[Sequence[int]]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """The batches of these steps, with a bar on a terminal and lines in the log."""
    title = f"epoch {state.epoch + 1} of {job.training.epochs}"
    batches = progress(_batches(job, state.epoch, steps, rank), len(steps), title)
    hidden = None if rank == 0 else True  # None: where there is no terminal
    with (
        logging_redirect_tqdm([log] if log.handlers else []),
        tqdm(batches, title, len(steps), leave=False, disable=hidden, unit="step") as bar,
    ):
        for batch in bar:
            if state.step:
                bar.set_postfix(loss=f"{state.loss / state.step:.3f}")
            yield batch


def _over(training: Training, state: _State) -> bool:
    return training.hours is not None and state.seconds >= 3600 * training.hours


def _end_epoch(
    job: _Job,
    rank: int,
    network: nn.Module,
    device: torch.device,
    precision: str,
    optimiser: torch.optim.Optimizer,
    state: _State,
    steps: int,
) -> None:
    """Validate, keep the weights if they are the best, add a row to the curves."""
    if rank == 0:
        epe, d1 = validate(network, job.held, device, precision)
        state.curve.append(
            {
                "epoch": state.epoch + 1,
                "step": (state.epoch + 1) * steps,
                "learning_rate": optimiser.param_groups[0]["lr"],
                "loss": round(state.loss / max(steps, 1), 6),
                "val_epe_px": round(epe, 5),
                "val_d1": round(d1, 6),
                "seconds": round(state.seconds, 1),
            }
        )
        log.info(
            "epoch %d of %d: loss %.4f, validation EPE %.3f px, D1 %.2f %%%s",
            state.epoch + 1,
            job.training.epochs,
            state.loss / max(steps, 1),
            epe,
            100 * d1,
            " (the best)" if epe < state.best else "",
        )
        if epe < state.best:
            state.best = epe
            save_model(
                job.work / "best.pt",
                job.model,
                network,
                {"key": job.key, "epoch": state.epoch + 1, "val_epe_px": epe, "val_d1": d1},
            )
    state.epoch, state.step, state.loss = state.epoch + 1, 0, 0.0


def _save(path: Path, record: Mapping[str, Any]) -> None:
    with replacing(path) as scratch:
        torch.save(dict(record), scratch)
        with scratch.open("rb") as stream:
            os.fsync(stream.fileno())


def _steps(job: _Job, epoch: int) -> list[list[int]]:
    """The numbers of the pairs in each step of an epoch, all processes together."""
    order = np.random.default_rng([job.training.seed, epoch]).permutation(len(job.data))
    size = min(job.training.batch_size * job.processes, len(order))
    return [order[k : k + size].tolist() for k in range(0, len(order) - size + 1, size)]


def _batches(
    job: _Job, epoch: int, steps: Sequence[Sequence[int]], rank: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """This process' share of each step."""
    job.data.epoch = epoch
    mine = [list(step[rank :: job.processes]) for step in steps]
    workers = job.training.loader_workers
    return iter(
        DataLoader(
            job.data,
            batch_sampler=mine,
            num_workers=workers,
            pin_memory=job.device == "cuda",
            multiprocessing_context="forkserver" if workers else None,
        )
    )


@torch.inference_mode()
def validate(
    network: nn.Module, held: LabelledPairs, device: torch.device, precision: str
) -> tuple[float, float]:
    """EPE (px) and D1 (share of errors over 3 px) over all labelled pixels of whole pairs."""
    network.eval()
    error = wrong = count = 0.0
    for left, right, disparity in DataLoader(held):
        valid = torch.isfinite(disparity)
        rows, cols = padding(*disparity.shape[1:], network.divisor)
        left, right = (F.pad(t, (0, cols, 0, rows)).to(device) for t in (left, right))
        with mixed(precision, device):
            found = network(left, right)[-1]
        found = found[:, : disparity.shape[1], : disparity.shape[2]].float().cpu()
        off = (found - disparity)[valid].abs().double()
        error += float(off.sum())
        wrong += float((off > 3).sum())
        count += int(valid.sum())
    return error / max(count, 1), wrong / max(count, 1)


# -------------------------------------------------------------------------------- what comes out


def _publish(job: _Job, provenance: dict[str, Any]) -> dict[str, Any]:
    """Put the best weights and the curves to their final place."""
    record = _read_state(job.work / "last.pt", job.key)
    if record is None or not record["state"]["curve"]:
        raise InputError(
            "no epoch was done", file=job.out, remedy="raise training.epochs or training.hours"
        )
    state = record["state"]
    model, network, best = load_model(job.work / "best.pt")
    summary = {
        "model": asdict(model),
        "training": asdict(job.training),
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
    save_model(job.out / "best.pt", model, network, {**provenance, **best})
    with (
        replacing(job.out / "curves.csv") as scratch,
        scratch.open("w", newline="", encoding="utf-8") as stream,
    ):
        writer = csv.DictWriter(stream, CURVE)
        writer.writeheader()
        writer.writerows(state["curve"])
    with replacing(job.out / "training.json") as scratch:
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

    from ..figures import save_figure

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
