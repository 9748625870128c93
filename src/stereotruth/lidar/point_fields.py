"""What the records of points tell beside their places, counted and coded as they are read.

Days. GPS times are seconds of a week, which tell no day, or seconds since 1980-01-06 less 10⁹ (LAS
1.4 R16, "Global Encoding", bit 0), or less another offset of the header of LAS 1.5 (bit 6). Days
count from 1970-01-01; 0 stands for none. A store has a code of 8 bits for the day of each point, 1
+ day modulo :data:`DAY_CODES`.

Strips of a flight (docs/explanation/real_sensors.md). Codes follow from a point alone, so that a
point has the same in any part of a file that is read: the ``point_source_id`` itself, or the time
in steps of :data:`BIN_S`, whose runs without a gap are strips (:func:`runs_of`). Only the strips of
edge flags, two of which follow each other far apart between strips, are numbered in their file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.kernels import inner, kernel
from ..core.numerics.arrays import Bools, Bytes, Floats, Ints, Words

if TYPE_CHECKING:
    import laspy

Days = NDArray[np.uint16]

ADJUSTED_S = 1e9
LATEST_S = 4e9  # of adjusted time: the year 2138
DAY_S = 86400.0
FIRST_DAY = date(1970, 1, 1)
LAST_DAY = np.iinfo(np.uint16).max
EPOCH_DAY = (date(1980, 1, 6) - FIRST_DAY).days
DAY_CODES = 255  # 0: not known
BY_CATALOGUE = "catalogue"

STRIP_CODES = 1 << 16  # a code has 16 bits; 0 of time: none
BIN_S = 10.0  # steps of a week have codes of their own; no aircraft turns in less
SOURCE, TIME, EDGES = "point_source_id", "GPS time", "edge of flight line"
MOST_BY_EDGES = 255  # strips of a file: with more, its points do not stand in the order of flight
LEAST_EDGES = 5  # of a strip, before a jump can be told from the steps between them
LOG_JUMP = float(np.log(60.0))  # of lines of pulses, over their geometric mean: overlaps are wider

FAR_SHARE, FAR_M = 0.1, 10.0  # of points outside of the header's bounds: see compare_bounds
SAMPLE_POINTS = 100_000  # first points of a file, on which quantised coordinates are looked for
NO_LIMITS = np.array([[np.iinfo(np.int64).max] * 3, [np.iinfo(np.int64).min] * 3])
_ANEW = "fetch the file again, or have its header written anew if that is what is wrong"


def number_of(day: str) -> int:
    """Days since 1970-01-01 of a day (ISO)."""
    return (date.fromisoformat(day) - FIRST_DAY).days


def day_of(number: int) -> str:
    """The day (ISO) so many days after 1970-01-01."""
    return (FIRST_DAY + timedelta(days=number)).isoformat()


def not_told_apart(days: Sequence[str]) -> list[str]:
    """The days (ISO) of a file that share their code with another one."""
    count = Counter(number_of(day) % DAY_CODES for day in days)
    return [day for day in days if count[number_of(day) % DAY_CODES] > 1]


def days_by_code(days: Sequence[str], acquired: Mapping[str, Any] | None) -> Days:
    """Day of each code [256], 0 where it is not known or shared.

    Where points tell no day, that of all of them is the middle of what a catalogue says
    (``acquired``).
    """
    out = np.zeros(DAY_CODES + 1, np.uint16)
    for number in map(number_of, set(days).difference(not_told_apart(days))):
        out[1 + number % DAY_CODES] = number
    if acquired is not None and acquired["by"] == BY_CATALOGUE:
        middle = (number_of(acquired["start"]) + number_of(acquired["end"])) // 2
        out[0] = middle if 0 < middle <= LAST_DAY else 0  # 1900-01-01 stands for none, too
    return out


def runs_of(steps: Sequence[int] | Ints) -> Ints:
    """First step of the run that each of some steps of time [n], ascending, belongs to.

    Between two runs lies a step in which no point was measured.
    """
    steps = np.asarray(steps, np.int64)
    first = np.diff(steps, prepend=-2) > 1
    return steps[first][np.cumsum(first) - 1] if steps.size else steps


@dataclass(eq=False)
class PointTally:
    """What is counted and checked along the way; nothing in it depends on the chunks.

    ``counts`` [2, 257], ``by_return`` [16], ``file_limits`` [2, 3] (stored coordinates): of all
    points, see :func:`_unpack`; ``lattice_limits`` [2, 3]: of points that are kept; ``synthetic``:
    points that nobody measured.
    """

    counts: Ints = field(default_factory=lambda: np.zeros((2, 257), np.int64))
    by_return: Ints = field(default_factory=lambda: np.zeros(16, np.int64))
    file_limits: Ints = field(default_factory=NO_LIMITS.copy)
    lattice_limits: Ints = field(default_factory=NO_LIMITS.copy)
    synthetic: int = 0
    _days: Bools = field(default_factory=lambda: np.zeros(1 << 16, np.bool_))
    _sources: Ints = field(default_factory=lambda: np.zeros(STRIP_CODES, np.int64))
    _others: Ints = field(default_factory=lambda: np.zeros(STRIP_CODES, np.int64))
    _edges: Floats = field(default_factory=lambda: np.zeros(7))
    _has_times: bool | None = None  # by the first point
    _sample: list[np.ndarray] = field(default_factory=list)

    def take(
        self,
        points: laspy.ScaleAwarePointRecord,
        header: laspy.LasHeader,
        drop_classes: Sequence[int],
    ) -> tuple[Floats, Words, Words]:
        """Coordinates [3, n], attributes [n] and codes of strips [n] of the points to keep.

        Attributes and codes: see :func:`_unpack` and :meth:`_strips_of`.
        """
        fields = points.array
        raw = np.frombuffer(fields, np.uint8).reshape(len(points), -1)
        xyz, attributes = np.empty((3, len(points))), np.zeros((2, len(points)), np.uint32)
        times = _times_of(fields, header)
        if header.global_encoding.gps_time_type.value == 1 and times is not None:
            _encode_days(times, self._days, attributes[0])
        attributes[1] = self._strips_of(fields, raw, times)
        extended = header.point_format.id >= 6
        bit = 1 if extended else 32  # of the flags in LAS 1.4, and of the class byte before
        self.synthetic += int(np.count_nonzero(raw[:, 15] & bit))
        kept = _unpack(
            raw,
            extended,
            np.isin(np.arange(256), drop_classes),
            np.array([header.scales, header.offsets], np.float64),
            xyz,
            attributes,
            self.counts,
            self.by_return,
            self.file_limits,
        )
        return xyz[:, :kept], attributes[0, :kept], attributes[1, :kept]

    def _strips_of(self, fields: np.ndarray, raw: Bytes, times: Floats | None) -> Words:
        """``point_source_id`` [n], and above bit 15 the code of the time or the edges."""
        code = fields["point_source_id"].astype(np.uint32)
        if not len(code):
            return code
        if self._has_times is None:
            self._has_times = times is not None and bool(times[0] != 0.0)
        if self._has_times and times is not None:
            steps = np.floor(np.where(np.isfinite(times), times, 0.0) / BIN_S) % (STRIP_CODES - 1)
            return code | np.where(times != 0.0, 1 + steps, 0).astype(np.uint32) << 16
        flags = raw[:, 15 if "classification_flags" in fields.dtype.names else 14]
        _by_edges(flags, np.stack([fields["X"], fields["Y"]], axis=1), self._edges, code)
        return code

    def count_strips(self, code: Words) -> None:
        """Count the codes of points that are kept."""
        self._sources += np.bincount(code & (STRIP_CODES - 1), minlength=STRIP_CODES)
        self._others += np.bincount(code >> 16, minlength=STRIP_CODES)

    @property
    def strips(self) -> tuple[str, int, dict[str, int]]:
        """What tells the strips of the points that are kept, the bit where its code begins, and
        the points of each code."""
        told, bit = SOURCE, 0
        here = np.flatnonzero(self._others)
        if np.count_nonzero(self._sources) <= 1:
            if not self._has_times and 1 < here.size <= MOST_BY_EDGES:
                told, bit = EDGES, 16
            elif self._has_times and np.unique(runs_of(here[here > 0])).size > 1:
                told, bit = TIME, 16
        counts = self._others if bit else self._sources
        return told, bit, {str(code): int(counts[code]) for code in np.flatnonzero(counts)}

    @property
    def days(self) -> list[str]:
        """All days (ISO) that points were measured on, in their order."""
        return [day_of(int(day)) for day in np.flatnonzero(self._days)]

    @property
    def read(self) -> int:
        """Points read, dropped ones included."""
        return int(self.counts.sum())

    @property
    def kept(self) -> int:
        """Points read that were not dropped."""
        return int(self.counts[0].sum())

    def widen(self, lattice: Ints) -> None:
        """Widen ``lattice_limits`` by points [3, n]."""
        if lattice.size:
            low, high = self.lattice_limits
            self.lattice_limits[0] = np.minimum(low, lattice.min(axis=1))
            self.lattice_limits[1] = np.maximum(high, lattice.max(axis=1))

    def extent(self, header: laspy.LasHeader) -> Floats:
        """Lowest and highest x, y, z of all points, [2, 3]."""
        return self.file_limits * np.asarray(header.scales) + np.asarray(header.offsets)

    def dropped(self, drop_classes: Sequence[int]) -> dict[str, int]:
        """Dropped points by reason; each counts under its first."""
        by_class = {f"class {c}": int(self.counts[1, c]) for c in drop_classes if 0 <= c < 256}
        return {"withheld": int(self.counts[1, 256])} | by_class

    def compare_bounds(
        self, header: laspy.LasHeader, units_m: tuple[float, float], file: Path
    ) -> str | None:
        """Refuse points far outside of the header's bounds: a damaged LAZ decodes into noise.

        ``units_m``: metres per unit of the plane and of the heights. Far is :data:`FAR_SHARE` of
        the side and :data:`FAR_M` more. Returns a remark where they lie outside at all.
        """
        mins, maxs = np.asarray(header.mins), np.asarray(header.maxs)
        size = maxs - mins
        if not (np.isfinite(size).all() and size.max() > 0):
            return None  # never filled in
        low, high = self.extent(header)
        beyond = np.maximum(mins - low, high - maxs)
        if (beyond <= 2 * np.asarray(header.scales)).all():
            return None
        corners = (
            "(" + ", ".join(f"{value:.2f}" for value in of) + ")" for of in (low, high, mins, maxs)
        )
        text = "points reach from {} to {}, the header says from {} to {}".format(*corners)
        metres = np.array([units_m[0], units_m[0], units_m[1]])
        if (beyond * metres > FAR_SHARE * size * metres + FAR_M).any():
            raise InputError(f"damaged: {text}", file=file, remedy=_ANEW)
        return text

    def compare_returns(self, header: laspy.LasHeader, file: Path) -> str | None:
        """Refuse a file whose points are of other returns than its header counts.

        They tell of points that are lost, invented or decoded into noise. Returns a remark where
        the header has all points under the first return, as careless software writes it.
        """
        stated = np.asarray(header.number_of_points_by_return, np.int64)
        stated = stated if header.version.minor >= 4 else stated[:5]
        read = self.by_return[1 : 1 + stated.size]
        if not stated.any() or (stated == read).all():
            return None
        texts = [", ".join(map(str, np.trim_zeros(of, "b").tolist())) for of in (stated, read)]
        text = f"the header counts {texts[0]} points by return, {texts[1]} were read"
        if stated[0] == header.point_count:
            return text
        raise InputError(f"truncated or damaged: {text}", file=file, remedy=_ANEW)

    def sample(self, lattice: Ints) -> None:
        """Keep the first points [3, n] for :meth:`refuse_quantised`."""
        missing = SAMPLE_POINTS - sum(map(len, self._sample))
        if missing > 0:
            # 32 bits each: 4.3 degrees, more than a file covers
            low = lattice[:2, :missing] & 0xFFFFFFFF
            self._sample.append(low[0] << 32 | low[1])

    def refuse_quantised(self, file: Path) -> None:
        """InputError if the file's first points share few positions."""
        sample = np.sort(np.concatenate([np.empty(0, np.int64), *self._sample]))  # not np.unique:
        positions = 1 + np.count_nonzero(np.diff(sample))  # it takes ten times as long
        if len(sample) >= 1000 and positions < 0.1 * len(sample):
            raise InputError(
                f"coordinates are quantised: {len(sample)} points lie on {positions} positions",
                file=file,
                remedy="write the file again with a finer scale (0.01 m, or 1e-7 degree)",
            )


def _times_of(fields: np.ndarray, header: laspy.LasHeader) -> Floats | None:
    """GPS times [n], s, absolute ones as adjusted time; None of formats without. 0 stays: none."""
    if "gps_time" not in fields.dtype.names:
        return None
    times = np.ascontiguousarray(fields["gps_time"])
    if header.version.minor < 5 or not header.global_encoding.gps_time_offset:
        return times
    shift_s = 1e6 * header.gps_time_offset - ADJUSTED_S
    return np.where(times != 0.0, times + shift_s, 0.0)


# Kernels free the GIL; nothing in them depends on how the points are cut into chunks.
@kernel
def _encode_days(times: Floats, seen: Bools, code: Words) -> None:
    """Fill ``code`` [n] from times (s, adjusted), and mark their days in ``seen``.

    0 and what is no time since 1980 were never filled in.
    """
    for i in range(times.size):
        code[i] = 0
        if times[i] != 0.0 and -ADJUSTED_S < times[i] < LATEST_S:
            day = EPOCH_DAY + np.int64((times[i] + ADJUSTED_S) / DAY_S)
            seen[day] = True
            code[i] = 1 + day % DAY_CODES


@kernel
def _by_edges(flags: Bytes, xy: NDArray[np.int32], state: Floats, code: Words) -> None:
    """Add the number of each point's strip [n], from 0 on, above bit 15 of ``code``.

    ``flags`` [n]: bytes with the flag of an edge in bit 7; ``xy`` [n, 2]: stored coordinates.
    ``state`` [7]: strips before, edges of this one, mean logarithm of the steps between them, the
    last two.
    """
    for i in range(flags.size):
        if flags[i] >> 7:
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


@inner
def _integer(raw: Bytes, i: int, at: int) -> int:
    value = np.int64(raw[i, at]) | np.int64(raw[i, at + 1]) << 8
    value |= np.int64(raw[i, at + 2]) << 16 | np.int64(raw[i, at + 3]) << 24
    return np.int64(np.int32(value))


@kernel
def _unpack(
    raw: Bytes,
    extended: bool,
    unwanted: Bools,
    scale_offset: Floats,
    xyz: Floats,
    attributes: Words,
    counts: Ints,
    by_return: Ints,
    limits: Ints,
) -> int:
    """Fill ``xyz`` [3, n] and ``attributes`` [2, n] with the points to keep; returns their number.

    ``raw`` [n, size] are point data records; ``extended``: of formats 6 to 10 (LAS 1.4 R16, "Point
    Data Record Format 0" and "6"). ``unwanted`` [256] by class; ``scale_offset`` [2, 3]. Attributes
    are class + 256 return number + 2**16 number of returns + 2**20 code of the day, and codes of
    the strip; those of all points come with the code of the day and of the strip. ``counts``
    [2, 257]: of kept and of dropped points by class, the last of withheld ones; ``by_return`` [16]:
    of all points by return number. ``limits`` [2, 3]: lowest and highest stored coordinates of all.
    """
    kept = 0
    low_x, low_y, low_z = limits[0]
    high_x, high_y, high_z = limits[1]
    for i in range(raw.shape[0]):
        x, y, z = _integer(raw, i, 0), _integer(raw, i, 4), _integer(raw, i, 8)
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
        returns, flags = np.int64(raw[i, 14]), np.int64(raw[i, 15])
        if extended:
            kind, withheld = np.int64(raw[i, 16]), flags >> 2 & 1
            returns = (returns & 15) << 8 | (returns >> 4) << 16
        else:
            kind, withheld = flags & 31, flags >> 7
            returns = (returns & 7) << 8 | (returns >> 3 & 7) << 16
        by_return[returns >> 8 & 15] += 1
        drop = withheld | np.int64(unwanted[kind])
        counts[drop, 256 if withheld == 1 else kind] += 1
        xyz[0, kept] = x * scale_offset[0, 0] + scale_offset[1, 0]
        xyz[1, kept] = y * scale_offset[0, 1] + scale_offset[1, 1]
        xyz[2, kept] = z * scale_offset[0, 2] + scale_offset[1, 2]
        attributes[0, kept] = kind | returns | np.int64(attributes[0, i]) << 20
        attributes[1, kept] = attributes[1, i]
        kept += 1 - drop
    limits[0] = low_x, low_y, low_z
    limits[1] = high_x, high_y, high_z
    return kept
