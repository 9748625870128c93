"""Pictures as they are looked at: their pixels, and how much of them has a colour."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.colors import to_rgb


def read_picture(path: Path) -> np.ndarray:
    """Red, green and blue, uint8[row, col, 3]; it must not be of one colour."""
    picture = cv2.imread(str(path))[..., ::-1]
    assert picture.std() > 5, f"{path.name} shows nothing"
    return picture


def share_of(picture: np.ndarray, colour: object) -> float:
    """Share of the pixels of a colour, in Matplotlib's words, to 3 of 255 levels."""
    wanted = np.rint(255 * np.array(to_rgb(colour)))
    return float((np.abs(picture - wanted).max(axis=2) <= 3).mean())


def colours_in(picture: np.ndarray) -> float:
    """Share of the pixels that are neither grey nor nearly so."""
    return float((np.ptp(picture.astype(int), axis=2) > 60).mean())
