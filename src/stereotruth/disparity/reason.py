"""What has changed where images and LiDAR show different surfaces."""

from __future__ import annotations

from enum import IntEnum


class Reason(IntEnum):
    """Codes of the layer ``change``; NONE where the status is not changed."""

    NONE = 0
    BUILT = 1
    DEMOLISHED = 2
    GROWN_OR_FELLED = 3
    MOVED = 4
    WATER = 5
    GROUND = 6
    UNKNOWN = 7
