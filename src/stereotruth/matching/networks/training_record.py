"""What a training leaves: weights, curves, figure, summary."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ...errors import InputError
from ...products.files import atomic_file, write_table
from .training_state import TrainingJob, read_state
from .weights import load_weights, save_weights

CURVE = ("epoch", "step", "learning_rate", "loss", "val_epe_px", "val_d1", "seconds")


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

    from ...products.pictures import save_figure

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
