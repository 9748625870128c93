"""When points were measured, by their GPS times where these are absolute.

LAS files have either seconds of a GPS week, which tell no day, or adjusted standard GPS time:
seconds since 1980-01-06 less 10⁹. Source: LAS 1.4 R16, "Global Encoding", bit 0, "GPS Time".
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import laspy
import numpy as np
from laspy.header import GpsTimeType

EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
ADJUSTED_S = 1e9
LATEST_S = 4e9  # of the epoch: the year 2106


def has_days(header: laspy.LasHeader) -> bool:
    """Whether the points' times tell the day."""
    names = set(header.point_format.dimension_names)
    return "gps_time" in names and header.global_encoding.gps_time_type == GpsTimeType.STANDARD


@dataclass
class GpsTimes:
    """First and last time of points, s of adjusted standard GPS time; no point: inf, -inf."""

    first: float = np.inf
    last: float = -np.inf

    def add(self, points: laspy.ScaleAwarePointRecord) -> None:
        """Take points' times, but for 0 and what is no time since 1980: never filled in."""
        times = points.array["gps_time"]
        good = times[(times != 0) & (times > -ADJUSTED_S) & (times < LATEST_S)]
        if good.size:
            self.first = min(self.first, float(good.min()))
            self.last = max(self.last, float(good.max()))

    @property
    def days(self) -> tuple[str, str] | None:
        """First and last day (ISO; of GPS time, which is 18 s off UTC at most), None if unknown."""
        if self.first > self.last:
            return None
        ends = (EPOCH + timedelta(seconds=ADJUSTED_S + end) for end in (self.first, self.last))
        first, last = (end.date().isoformat() for end in ends)
        return first, last
