"""What a method was trained on, its licence, and whether it has seen the dataset before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from ..methods.kinds import KINDS, MCCNN

NOTHING = "nothing"
NOT_STATED = "not stated"
US3D = "US3D"  # the Data Fusion Contest of 2019
COLUMNS = {
    "trained_on": "trained on",
    "licence": "licence",
    "seen_in_training": "dataset seen in training",
}


def training_data(of: Mapping[str, Any]) -> dict[str, str]:
    """The columns of COLUMNS for the summary of a method, ``scores.json``.

    A method states ``trained_on`` in its entry. Known without that: methods that learn nothing,
    MC-CNN, and networks that rule ``train`` trained, on the training pairs of a dataset.
    """
    dataset, settings = of["dataset"], of["settings"]
    stated = list(settings.get("trained_on") or ())
    own = _trained_here(settings)
    if own:
        stated.append(f"{own}, training pairs")
    elif not stated and settings["kind"] == "pandora" and settings.get("pipeline") == MCCNN:
        stated = [US3D]
    licence = settings.get("licence") or (of.get("identity") or {}).get("licence") or NOT_STATED
    if not stated:
        learns = settings["kind"] not in ("sgm", "pandora") or settings.get("pipeline")
        trained = NOT_STATED if learns else NOTHING
        seen = NOT_STATED if learns else "no"
    else:
        trained = "; ".join(stated)
        names = {name.casefold() for name in stated}
        seen = "yes" if dataset.casefold() in names else "no"
        if seen == "no" and own == dataset:
            seen = "training pairs only"
    return {"trained_on": trained, "licence": licence, "seen_in_training": seen}


def _trained_here(settings: Mapping[str, Any]) -> str | None:
    """The dataset that rule ``train`` trained a network on; None: weights from elsewhere."""
    if not KINDS[settings["kind"]].is_network:
        return None
    parts = PurePath(settings.get("weights") or "").parts
    return parts[2] if parts[:2] == ("results", "train") and len(parts) > 3 else None
