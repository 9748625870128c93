"""Training and fine-tuning of the stereo networks (paper, section V).

Smooth L1 over the labelled pixels of each output, Adam, learning rate halved every so many epochs,
the weights that do best on the validation pairs are kept.

The state of a training lies in a hidden folder beside its product (``.<name>.work/last.pt``,
written whole): weights, optimiser, place in the epoch. A killed training goes on from there, and
on one CPU ends with the weights of an undisturbed one; with other settings or data it starts anew.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import DataLoader

from stereotruth.core.errors import InputError
from stereotruth.core.job import progress
from stereotruth.core.products.making import exclusive
from stereotruth.tiles.stereo_dataset import StereoDataset

from .inference import choose_device, mixed, padding, precision_of
from .layers import channels_last
from .training_pairs import LabelledPairs
from .training_state import (
    FORMAT,
    TrainingJob,
    TrainingSettings,
    TrainingState,
    freeze_parts,
    make_optimiser,
    publish_training,
    read_state,
    save_state,
    start,
)
from .weights import SavedNetwork, save_weights

log = logging.getLogger("stereotruth")


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


def train(
    model: SavedNetwork,
    dataset: StereoDataset,
    out: str | Path,
    training: TrainingSettings,
    provenance: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Train a network on a dataset's ``train`` pairs and keep the best on its ``val`` pairs.

    Writes into the folder ``out``: ``best.pt``, ``curves.csv``, ``curves.png``, ``training.json``.
    Returns what the last of them holds.

    Raises InputError if there are no pairs to train or validate on, if crops do not fit the
    network or the pairs, or if the loss is no number any more.
    """
    network = start(model, training)
    if any(side % network.divisor for side in training.crop_px or ()):
        raise InputError(
            f"training.crop_px {list(training.crop_px)}: no multiples of {network.divisor} px",
            remedy=f"{type(network).__name__} needs them",
        )
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
    job = TrainingJob(model, training, data, held, out, work, device.type, processes)
    log.info("training %s", job.key)  # of the files as they are before any is read
    with exclusive(out):
        if processes > 1:
            rendezvous = work / "rendezvous"
            rendezvous.unlink(missing_ok=True)
            torch.multiprocessing.spawn(_run_one, (job, rendezvous), nprocs=processes)
        else:
            _run(job, 0, network, device)
        return publish_training(job, dict(provenance or {}))


def _run_one(rank: int, job: TrainingJob, rendezvous: Path) -> None:
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


def _run(job: TrainingJob, rank: int, network: nn.Module, device: torch.device) -> None:
    """Train until all epochs are done or the hours are over."""
    training, alone = job.training, job.processes == 1
    if training.threads:
        torch.set_num_threads(training.threads)
    network = channels_last(network.to(device))
    frozen = freeze_parts(network, training.frozen)
    if not alone and device.type == "cuda":
        network = nn.SyncBatchNorm.convert_sync_batchnorm(network)
    optimiser = make_optimiser(network, training.learning_rate)
    state, last = TrainingState(), job.work / "last.pt"
    key = job.key
    if (record := read_state(last, key)) is not None:
        network.load_state_dict(record["weights"])
        optimiser.load_state_dict(record["optimiser"])
        state = TrainingState(**record["state"])
        log.info("goes on in epoch %d, after %d steps of it", state.epoch + 1, state.step)
    shared = network
    if not alone:
        ids = [device.index] if device.type == "cuda" else None
        shared = nn.parallel.DistributedDataParallel(network, device_ids=ids)
    precision = precision_of(training.precision, device, "bfloat16")
    scaler = torch.amp.GradScaler(device.type, enabled=precision == "float16")

    def keep() -> None:
        if rank == 0:
            job.refuse_changed()
            save_state(
                last,
                {
                    "format": FORMAT,
                    "key": key,
                    "weights": network.state_dict(),
                    "optimiser": optimiser.state_dict(),
                    "state": asdict(state),
                },
            )

    most_seconds = np.inf if training.hours is None else 3600 * training.hours
    while state.epoch < training.epochs and state.seconds < most_seconds:
        for group in optimiser.param_groups:
            halvings = state.epoch // training.halve_every_epochs
            group["lr"] = training.learning_rate * 0.5**halvings
        network.train()
        for part in frozen:  # with the statistics that its weights were trained with
            part.eval()
        began = saved = time.monotonic()
        steps = _steps(job, state.epoch)
        before = state.seconds
        batches = _batches(job, state.epoch, steps[state.step :], rank)
        title = f"epoch {state.epoch + 1} of {training.epochs}"
        for left, right, disparity in progress(batches, len(steps) - state.step, title):
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


def _end_epoch(
    job: TrainingJob,
    rank: int,
    network: nn.Module,
    device: torch.device,
    precision: str,
    optimiser: torch.optim.Optimizer,
    state: TrainingState,
    steps: int,
) -> None:
    """Validate, keep the weights if they are the best, add a row to the curves."""
    if rank == 0:
        job.refuse_changed()
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
            save_weights(
                job.work / "best.pt",
                job.model,
                network,
                {"key": job.key, "epoch": state.epoch + 1, "val_epe_px": epe, "val_d1": d1},
            )
    state.epoch, state.step, state.loss = state.epoch + 1, 0, 0.0


def _steps(job: TrainingJob, epoch: int) -> list[list[int]]:
    """The numbers of the pairs in each step of an epoch, all processes together."""
    order = np.random.default_rng([job.training.seed, epoch]).permutation(len(job.data))
    size = min(job.training.batch_size * job.processes, len(order))
    return [order[k : k + size].tolist() for k in range(0, len(order) - size + 1, size)]


def _batches(job: TrainingJob, epoch: int, steps: Sequence[Sequence[int]], rank: int) -> DataLoader:
    """This process' share of each step: left, right, disparity."""
    job.data.epoch = epoch
    mine = [list(step[rank :: job.processes]) for step in steps]
    workers = job.training.loader_workers
    return DataLoader(
        job.data,
        batch_sampler=mine,
        num_workers=workers,
        pin_memory=job.device == "cuda",
        multiprocessing_context="forkserver" if workers else None,
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
