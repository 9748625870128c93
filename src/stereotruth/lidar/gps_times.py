"""On which days points were measured, by their GPS times where these are absolute.

LAS files have either seconds of a GPS week, which tell no day, or adjusted standard GPS time:
seconds since 1980-01-06 less 10⁹. Source: LAS 1.4 R16, "Global Encoding", bit 0, "GPS Time".

Days are counted from 1970-01-01; day 0 stands for none. They are those of GPS time, which is 18 s
off UTC at most. A point store has a code of 8 bits for the day of each point, 1 + day modulo
:data:`CODES`, and the days of its file (:func:`days_by_code`): the code of a point follows from the
point alone, whatever else of the file is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel

if TYPE_CHECKING:
    import laspy

Words = NDArray[np.uint32]
Days = NDArray[np.uint16]

ADJUSTED_S = 1e9
LATEST_S = 4e9  # of adjusted time: the year 2138
DAY_S = 86400.0
FIRST_DAY = date(1970, 1, 1)
LAST_DAY = np.iinfo(np.uint16).max
EPOCH_DAY = (date(1980, 1, 6) - FIRST_DAY).days
CODES = 255  # of days; 0: not known
BY_CATALOGUE = "catalogue"


@kernel
def _encode(times: NDArray[np.float64], seen: NDArray[np.bool_], code: Words) -> None:
    """Fill ``code`` [n] from times (s, adjusted), and mark their days in ``seen``.

    0 and what is no time since 1980 were never filled in.
    """
    for i in range(times.size):
        code[i] = 0
        if times[i] != 0.0 and -ADJUSTED_S < times[i] < LATEST_S:
            day = EPOCH_DAY + np.int64((times[i] + ADJUSTED_S) / DAY_S)
            seen[day] = True
            code[i] = 1 + day % CODES


@dataclass(eq=False)
class GpsDays:
    """Days of points, by their times; ``seen`` [days]: those that any of them was measured on."""

    seen: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(1 << 16, np.bool_))

    def take(self, points: laspy.ScaleAwarePointRecord, code: Words) -> None:
        """Fill ``code`` [n] with those of points."""
        _encode(np.ascontiguousarray(points.array["gps_time"]), self.seen, code)

    @property
    def days(self) -> list[str]:
        """All days (ISO), in their order."""
        return [day_of(int(day)) for day in np.flatnonzero(self.seen)]


def number_of(day: str) -> int:
    """Days since 1970-01-01 of a day (ISO)."""
    return (date.fromisoformat(day) - FIRST_DAY).days


def day_of(number: int) -> str:
    """The day (ISO) so many days after 1970-01-01."""
    return (FIRST_DAY + timedelta(days=number)).isoformat()


def not_told_apart(days: Sequence[str]) -> list[str]:
    """The days (ISO) of a file that share their code with another one."""
    count = Counter(number_of(day) % CODES for day in days)
    return [day for day in days if count[number_of(day) % CODES] > 1]


def days_by_code(days: Sequence[str], acquired: Mapping[str, Any] | None) -> Days:
    """Day of each code [256], 0 where it is not known (:func:`not_told_apart`).

    Where points tell no day, that of all of them is the middle of what a catalogue says
    (``acquired``).
    """
    out = np.zeros(CODES + 1, np.uint16)
    for number in map(number_of, set(days).difference(not_told_apart(days))):
        out[1 + number % CODES] = number
    if acquired is not None and acquired["by"] == BY_CATALOGUE:
        middle = (number_of(acquired["start"]) + number_of(acquired["end"])) // 2
        out[0] = middle if 0 < middle <= LAST_DAY else 0  # 1900-01-01 stands for none, too
    return out
