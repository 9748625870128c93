"""A folder of predictions, as those read it who compare them with labels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import plain_name
from stereotruth.core.products.rasters import read_disparity
from stereotruth.tiles.stereo_dataset import Pair

RECORD = "predictions.json"
UNCERTAINTY = "uncertainty"  # folder in it


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
