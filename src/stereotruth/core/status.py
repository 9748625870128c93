"""Why a pixel has a label or none, and what has changed there: one table for all who ask."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Status(IntEnum):
    """The statuses of disparity stores and tiles. Numbers stay as they were published.

    ``label``: name in stores and tables; ``meaning``; ``colour``: in pictures, #rrggbb, apart for
    all eyes, and light where there is a label; ``carries_label``; ``hidden``: one view alone shows
    the pixel.
    """

    NO_POINTS = 0, "no point of the LiDAR, and no surface", "#1c1c22"
    LABELLED = 1, "measured by points in the pixel", "#eef3f7", True
    HIDDEN_IN_LEFT = 2, "something hides it in the left view", "#d09230", False, True
    HIDDEN_IN_RIGHT = 3, "something hides it in the right view", "#a2006a", False, True
    LOW_CORRELATION = 4, "recipe `paper`: the images do not correlate there", "#5e41ed"
    CHANGED = 5, "LiDAR and images show different surfaces, or water", "#effa51"
    OUT_OF_FRAME = 6, "the right image does not reach it", "#b7928d"
    BELOW_MINIMUM_COUNT = 7, "recipe `paper`: too few points", "#6a6028"
    EDGE_IN_PIXEL = 8, "what its centre sees is not known: an edge is near", "#2183d5"
    LABELLED_BETWEEN = 9, "between points", "#aab1dc", True
    LABELLED_BY_IMAGES = 10, "in datasets of earlier versions alone", "#ffe9b8", True
    MASKED = 11, "a mask hides it", "#172d93"
    LABELLED_CROWN = 12, "a rough surface, less sure", "#cce674", True
    TOO_UNCERTAIN = (
        13,
        "in tiles alone: a `labelled_crown` with an uncertainty above `tiles.max_uncertainty_px`; "
        "the disparity store has its label",
        "#204020",
    )

    def __new__(
        cls,
        number: int,
        meaning: str,
        colour: str,
        carries_label: bool = False,
        hidden: bool = False,
    ) -> Status:
        """A status with all that is said of it."""
        self = int.__new__(cls, number)
        self._value_ = number
        self.meaning, self.colour = meaning, colour
        self.carries_label, self.hidden = carries_label, hidden
        return self

    @property
    def label(self) -> str:
        """Its name in stores and tables."""
        return self.name.lower()


BY_LABEL = {status.label: status for status in Status}
HIDDEN = tuple(status.label for status in Status if status.hidden)
_CARRIES_LABEL = np.zeros(256, np.bool_)
_CARRIES_LABEL[[status for status in Status if status.carries_label]] = True


def is_labelled(status: NDArray[np.uint8] | int) -> Any:
    """Where a status says that there is a label."""
    return _CARRIES_LABEL[status]


def carries_label(label: str) -> bool:
    """Whether the status of a name does; names of other software's statuses do not."""
    return label in BY_LABEL and BY_LABEL[label].carries_label


def statuses_of(recipe: str, masked: bool) -> list[Status]:
    """Those that the grids of a recipe name; ``masked``: whether masks hide something."""
    statuses = [status for status in Status if status <= Status.EDGE_IN_PIXEL]
    if recipe == "surface":
        statuses += [Status.LABELLED_BETWEEN, Status.LABELLED_CROWN]
    return [*statuses, *([Status.MASKED] if masked else [])]


class Reason(IntEnum):
    """What has changed where images and LiDAR show different surfaces: codes of the layer
    ``change``; NONE where the status is not changed."""

    NONE = 0
    BUILT = 1
    DEMOLISHED = 2
    GROWN_OR_FELLED = 3
    MOVED = 4
    WATER = 5
    GROUND = 6
    UNKNOWN = 7
