"""A folder of predictions, as those read it who compare them with labels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...dataset.stereo_dataset import Pair
from ...errors import InputError
from ...products.rasters import read_disparity

RECORD = "predictions.json"
UNCERTAINTY = "uncertainty"  # folder in it


def read_record(folder: str | Path) -> dict[str, Any]:
    """The record of a folder of predictions. Raises InputError if there is none."""
    file = Path(folder) / RECORD
    if not file.is_file():
        raise InputError("no predictions", file=file, remedy="run rule match")
    return json.loads(file.read_text(encoding="utf-8"))


def read_prediction(folder: str | Path, pair: Pair) -> NDArray[np.float32]:
    """A pair's prediction, float32[h, w] px, NaN where there is none."""
    return read_disparity(Path(folder) / f"{pair.name}.tiff", np.nan)


def read_uncertainty(folder: str | Path, pair: Pair) -> NDArray[np.float32] | None:
    """The standard uncertainty of a pair's prediction, float32[h, w] px; None: not stated."""
    file = Path(folder) / UNCERTAINTY / f"{pair.name}.tiff"
    return read_disparity(file, np.nan) if file.is_file() else None
