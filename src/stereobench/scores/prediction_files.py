"""Folders of predictions: as rule match leaves them, and packed to be scored on another machine.

A submission is a folder of results as kind ``folder`` takes it, ``<pair>.tif`` and, where the
method states it, ``<pair>_uncertainty.tif``, with ``submission.json``: protocol id and definition,
scores (none where the labels are sealed), what the method is, who submits it, its licence, training
data and seed, on which machine it ran, the checksum of each file. Who takes it as a method of kind
``folder``, or for a board, scores it again: files that were changed since are refused, and so are
scores by another protocol, or other ones by the same.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_folder, plain_name
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import read_disparity
from stereotruth.tiles.stereo_dataset import Pair

from .published import training_data

RECORD = "predictions.json"
UNCERTAINTY = "uncertainty"  # folder of a folder of predictions
FILE = "submission.json"
SUBMITTED = "submitted"  # of a record of predictions: the scores that its submission states
TOLERANCE = 2e-6  # of figures that are rounded to 1e-6
Figure = int | float | None
KEPT = ("dataset", "identity", "machine", "device", "threads")


def read_record(folder: str | Path) -> dict[str, Any]:
    """The record of a folder of predictions; the names of its pairs are plain names.

    Raises InputError if there is none, or it is no record.
    """
    file = Path(folder) / RECORD
    if not file.is_file():
        raise InputError("no predictions", file=file, remedy="run rule match")
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        pairs = record["pairs"]
        names = list(pairs.keys())
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError("no record of predictions", file=file, remedy="run rule match") from None
    for name in names:
        plain_name(name, "the name of a pair,", file)
    return record


def read_prediction(folder: str | Path, pair: Pair) -> NDArray[np.float32]:
    """A pair's prediction, float32[h, w] px, NaN where there is none."""
    return read_disparity(Path(folder) / f"{pair.name}.tiff", np.nan)


def read_uncertainty(folder: str | Path, pair: Pair) -> NDArray[np.float32] | None:
    """The standard uncertainty of a pair's prediction, float32[h, w] px; None: not stated."""
    file = Path(folder) / UNCERTAINTY / f"{pair.name}.tiff"
    return read_disparity(file, np.nan) if file.is_file() else None


def pack(predictions: str | Path, scores: str | Path | None, out: str | Path) -> dict[str, Any]:
    """Write the submission of a method; returns what ``submission.json`` holds.

    ``predictions``, ``scores``: folders of rules match and score; no scores of sealed labels.
    """
    predictions = Path(predictions)
    record = read_record(predictions)
    settings, pairs, scored = record["settings"], record["pairs"], {}
    label = settings.get("label") or record["method"]
    if scores is not None:
        summary = json.loads((Path(scores) / "scores.json").read_text(encoding="utf-8"))
        label = summary["label"]
        scored = {"scores": {key: summary[key] for key in ("protocol", "all", "cities", "strata")}}
    training = training_data(record)
    with atomic_folder(out) as scratch:
        for pair in pairs:
            for name, file in (
                (f"{pair}.tif", predictions / f"{pair}.tiff"),
                (f"{pair}_{UNCERTAINTY}.tif", predictions / UNCERTAINTY / f"{pair}.tiff"),
            ):
                if file.is_file():
                    shutil.copyfile(file, scratch / name)
        packed = {
            "label": label,
            "by": settings.get("by", ""),
            "seed": settings.get("seed"),
            "licence": training["licence"],
            "trained_on": training["trained_on"],
            **{key: record[key] for key in KEPT},
            **scored,
            "pairs": pairs,
            "files": {file.name: file_sha256(file) for file in sorted(scratch.iterdir())},
        }
        text = json.dumps(packed, indent=2) + "\n"
        (scratch / FILE).write_text(text, encoding="utf-8")
    return packed


@dataclass(frozen=True)
class Submission:
    """A folder as :func:`pack` writes it.

    ``files``: checksums by name; ``scores``: those it states, empty where the labels are sealed;
    ``facts``: all that ``submission.json`` holds.
    """

    folder: Path
    files: Mapping[str, str]
    scores: Mapping[str, Any]
    facts: Mapping[str, Any]

    @classmethod
    def of(cls, folder: Path) -> Self | None:
        """That of a folder of results; None if it is none. Raises InputError if it is spoilt."""
        file = folder / FILE
        if not file.is_file():
            return None
        try:
            packed = json.loads(file.read_text(encoding="utf-8"))
            names, scores = list(packed["files"].keys()), packed.get("scores") or {}
            figures = list(_figures(scores)) if scores else []
            if wrong := [name for name, of in figures if not isinstance(of, Figure)]:
                raise TypeError(wrong)
            protocol = scores["protocol"]["id"] if scores else "none"
        except (ValueError, KeyError, TypeError, AttributeError):
            raise InputError("no submission", file=file, remedy="take the file as it was") from None
        for name in names:
            plain_name(name, "the name of a result,", file)
        plain_name(protocol, "the protocol's id", file)
        return cls(folder, packed["files"], scores, packed)

    def check(self, files: Iterable[Path]) -> None:
        """Raise InputError unless the files are as they were packed."""
        for file in files:
            if self.files.get(file.name) != file_sha256(file):
                raise InputError(
                    "file is not as it was submitted",
                    file=file,
                    remedy=f"take the submission as it was, or delete its {FILE}",
                )


def hold_against(submitted: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
    """Raise InputError unless a submission's scores are those of a summary.

    Held against each other are the protocols, and all figures but the confidence intervals, which
    depend on a seed: by city, by stratum, and of all.
    """
    ids = [of["protocol"]["id"] for of in (submitted, summary)]
    if ids[0] != ids[1]:
        raise InputError(
            f"submitted by protocol {ids[0]}, scored by {ids[1]}",
            remedy="take the dataset, its protocol and the section benchmark as they were there",
        )
    theirs, ours = (list(_figures(of)) for of in (submitted, summary))
    if [name for name, _ in theirs] != [name for name, _ in ours]:
        raise InputError(
            "cities or strata are not those of the submission",
            remedy="score with the workflow's products of the same scenes",
        )
    for (name, was), (_, found) in zip(theirs, ours):
        same = was == found or (
            None not in (was, found) and abs(was - found) <= TOLERANCE * max(1, abs(was))
        )
        if not same:
            raise InputError(
                f"{name} is {found}, submitted as {was}", remedy="ask who submitted it"
            )


def _figures(summary: Mapping[str, Any]) -> Iterable[tuple[str, float | None]]:
    for row in (summary["all"], *summary["cities"], *summary["strata"]):
        place = row.get("city") or row["stratum"]
        for key, value in row.items():
            told = ("city", "stratum", "no_interval")
            if key not in told and not key.endswith(("_low", "_high")):
                yield f"{key} of {place}", value
