"""Why a pixel has a label or none."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

WATER_CLASS = 9  # ASPRS
VEGETATION_CLASSES = (3, 4, 5)


class Status(IntEnum):
    """Why a pixel has a label or none. Numbers stay as they were published.

    LABELLED_BY_IMAGES stands in grids of earlier versions alone: no recipe gives it.
    """

    NO_POINTS = 0
    LABELLED = 1
    HIDDEN_IN_LEFT = 2
    HIDDEN_IN_RIGHT = 3
    LOW_CORRELATION = 4
    CHANGED = 5
    OUT_OF_FRAME = 6
    BELOW_MINIMUM_COUNT = 7
    EDGE_IN_PIXEL = 8
    LABELLED_BETWEEN = 9
    LABELLED_BY_IMAGES = 10
    MASKED = 11
    LABELLED_CROWN = 12
    TOO_UNCERTAIN = 13  # in tiles alone


def is_labelled(status: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where a status says that there is a label: measured, between points, by images, or of a
    rough surface."""
    between = (status >= Status.LABELLED_BETWEEN) & (status <= Status.LABELLED_BY_IMAGES)
    return (status == Status.LABELLED) | between | (status == Status.LABELLED_CROWN)


def statuses_of(recipe: str) -> list[Status]:
    """Those that the grids of a recipe name; MASKED comes with masks alone."""
    statuses = [status for status in Status if status <= Status.EDGE_IN_PIXEL]
    if recipe == "surface":
        statuses += [Status.LABELLED_BETWEEN, Status.LABELLED_CROWN]
    return statuses
