"""Why a pixel has a label or none."""

from __future__ import annotations

from enum import IntEnum

WATER_CLASS = 9  # ASPRS


class Status(IntEnum):
    """Why a pixel has a label or none."""

    NO_POINTS = 0
    LABELLED = 1
    HIDDEN_IN_LEFT = 2
    HIDDEN_IN_RIGHT = 3
    LOW_CORRELATION = 4
    CHANGED = 5
    OUT_OF_FRAME = 6
    BELOW_MINIMUM_COUNT = 7
    EDGE_IN_PIXEL = 8
