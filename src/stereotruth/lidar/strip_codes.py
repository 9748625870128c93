"""Which strip of a flight each point was measured in, by what its file tells.

A strip is told, in this order,

- by ``point_source_id``, where points of a file have more than one. Some vendors give all points
  one value, or 0;
- by GPS times, where no point was measured for a while: an aircraft turns between its strips. Both
  kinds of time serve, of the week and adjusted;
- by flags of the edge of a flight line, where the points have no times and stand in the order in
  which they were measured: two edges that follow each other are a line of pulses apart within a
  strip, and far apart between strips.

A code follows from a point alone, so that points of a strip have the same in all files that it runs
through, whatever part of these is read: the ``point_source_id`` itself, or the time in steps of
:data:`BIN_S`. Strips are runs of steps without a gap (:func:`runs_of`). Only the strips of edge
flags are numbered within their file. Source of the fields: LAS 1.4 R16, "Point Data Record Format".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel

if TYPE_CHECKING:
    import laspy

Words = NDArray[np.uint32]
Floats = NDArray[np.float64]

CODES = 1 << 16  # a code has 16 bits; 0 of time: none
BIN_S = 10.0  # steps of a week have codes of their own; no aircraft turns in less
SOURCE, TIME, EDGES = "point_source_id", "GPS time", "edge of flight line"
MOST_BY_EDGES = 255  # strips of a file: with more, its points do not stand in the order of flight
LEAST_EDGES = 5  # of a strip, before a jump can be told from the steps between them
LOG_JUMP = float(np.log(60.0))  # of lines of pulses, over their geometric mean: overlaps are wider


@kernel
def _by_edges(
    raw: NDArray[np.uint8], flags_at: int, xy: NDArray[np.int32], state: Floats, code: Words
) -> None:
    """Add the number of each point's strip [n], from 0 on, above bit 15 of ``code``.

    ``raw`` [n, size]: records with the flag in bit 7 of byte ``flags_at``; ``xy`` [n, 2]: stored
    coordinates. ``state`` [7]: strips before, edges of this one, mean logarithm of the steps
    between them, the last two.
    """
    for i in range(raw.shape[0]):
        if raw[i, flags_at] >> 7:
            x, y = np.float64(xy[i, 0]), np.float64(xy[i, 1])
            step = min(np.hypot(x - state[3], y - state[4]), np.hypot(x - state[5], y - state[6]))
            log_step = np.log(max(step, 1.0))
            if state[1] > LEAST_EDGES and log_step > state[2] + LOG_JUMP:
                state[0] += 1.0
                state[1] = state[2] = 0.0
            elif state[1] > 0.0:
                state[2] += (log_step - state[2]) / state[1]
            state[5], state[6] = (state[3], state[4]) if state[1] > 0.0 else (x, y)
            state[3], state[4] = x, y
            state[1] += 1.0
        code[i] |= np.uint32(min(state[0], MOST_BY_EDGES)) << 16


@dataclass(eq=False)
class StripCodes:
    """Codes of the points of a file; nothing in them depends on how it is cut into chunks."""

    sources: NDArray[np.int64] = field(default_factory=lambda: np.zeros(CODES, np.int64))
    others: NDArray[np.int64] = field(default_factory=lambda: np.zeros(CODES, np.int64))
    edges: Floats = field(default_factory=lambda: np.zeros(7))
    times: bool | None = None  # whether the points have any, by the first one

    def take(self, points: laspy.ScaleAwarePointRecord) -> Words:
        """Codes [n] of points: ``point_source_id``, and above bit 15 that of time or edges."""
        fields = points.array
        code = fields["point_source_id"].astype(np.uint32)
        if self.times is None and len(code):
            self.times = "gps_time" in fields.dtype.names and fields["gps_time"][0] != 0.0
        if self.times:
            time = fields["gps_time"]
            steps = np.floor(np.where(np.isfinite(time), time, 0.0) / BIN_S) % (CODES - 1)
            code |= np.where(time != 0.0, 1 + steps, 0).astype(np.uint32) << 16
        elif len(code):
            raw = np.frombuffer(fields, np.uint8).reshape(len(fields), -1)
            extended = "classification_flags" in fields.dtype.names
            xy = np.stack([fields["X"], fields["Y"]], axis=1)
            _by_edges(raw, 15 if extended else 14, xy, self.edges, code)
        return code

    def count(self, code: Words) -> None:
        """Count the codes of points that are kept."""
        self.sources += np.bincount(code & (CODES - 1), minlength=CODES)
        self.others += np.bincount(code >> 16, minlength=CODES)

    @property
    def told(self) -> tuple[str, int]:
        """What tells the strips of the points that are kept, and the bit where its code begins."""
        if np.count_nonzero(self.sources) > 1:
            return SOURCE, 0
        here = np.flatnonzero(self.others)
        if self.times:
            timed = here[here > 0]
            return (TIME, 16) if np.unique(runs_of(timed)).size > 1 else (SOURCE, 0)
        return (EDGES, 16) if 1 < here.size <= MOST_BY_EDGES else (SOURCE, 0)

    @property
    def counts(self) -> dict[str, int]:
        """Points that are kept by their code."""
        counts = self.others if self.told[1] else self.sources
        return {str(code): int(counts[code]) for code in np.flatnonzero(counts)}


def runs_of(steps: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    """First step of the run that each of some steps of time [n], ascending, belongs to.

    Between two runs lies a step in which no point was measured.
    """
    steps = np.asarray(steps, np.int64)
    first = np.diff(steps, prepend=-2) > 1
    return steps[first][np.cumsum(first) - 1] if steps.size else steps
