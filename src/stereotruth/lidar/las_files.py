"""LAS, LAZ and COPC files: headers held against the file, points in chunks, what was read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import laspy
import numpy as np
from laspy.header import GpsTimeType
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.kernels import inner, kernel
from ..core.products.file_parts import GLANCE_BYTES, STREAM_BYTES, open_stream
from ..core.products.remote_files import size_of
from .gps_times import GpsDays
from .las_layout import check_layout, wrong_count
from .strip_codes import StripCodes

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]


FAR_SHARE, FAR_M = 0.1, 10.0  # of points outside of the header's bounds: see compare_bounds
_ANEW = "fetch the file again, or have its header written anew if that is what is wrong"
SAMPLES = 16  # points all over a file that its header's bounds are held against
LAZ_CHUNK = 50_000  # points of a chunk, as all software writes it
SAMPLE_POINTS = 100_000  # first points of a file, on which quantised coordinates are looked for


def has_days(header: laspy.LasHeader) -> bool:
    """Whether the points' times tell the day."""
    names = set(header.point_format.dimension_names)
    return "gps_time" in names and header.global_encoding.gps_time_type == GpsTimeType.STANDARD


@contextmanager
def _decoding(refusal: Callable[[BaseException], InputError]) -> Iterator[None]:
    """Whatever libraries raise on damaged bytes becomes a refusal.

    Panics of lazrs too, which are no Exception; want of memory not.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise refusal(error) from error


def read_header(file: str | Path, layers: bool = True) -> laspy.LasHeader:
    """Header of a LAS or LAZ file whose counts agree with what the file holds.

    ``layers``: see :func:`.las_layout.check_layout`.

    Raises InputError: missing, no LAS, empty, truncated (both counts are named).
    """
    file = Path(file)
    if not file.is_file():
        raise InputError("no such LiDAR file", file=file, remedy="correct the path in scenes.tsv")
    check_layout(file, layers)
    with (
        _decoding(
            lambda error: InputError(
                f"no readable LAS or LAZ file ({error})",
                file=file,
                remedy="check or replace the file",
            )
        ),
        open_stream(file, STREAM_BYTES if layers else GLANCE_BYTES) as stream,
    ):
        header = laspy.LasHeader.read_from(stream, read_evlrs=True)
    by_return = sum(map(int, header.number_of_points_by_return))
    if by_return > header.point_count:
        raise wrong_count(file, header.point_count, f"its counts by return add up to {by_return}")
    return header


def surplus_of(header: laspy.LasHeader, file: Path) -> str | None:
    """Remark on points after the last that the header counts (a stale header), or None."""
    if header.are_points_compressed or header.version.minor == 3:  # 1.3: waveforms may follow
        return None
    end = header.start_of_first_evlr if header.number_of_evlrs else size_of(file)
    held = (end - header.offset_to_point_data) // header.point_format.size
    if held <= header.point_count:
        return None
    return f"the header announces {header.point_count} points, which are read; {held} would fit"


def read_chunks(
    file: Path, header: laspy.LasHeader, size: int
) -> Iterator[laspy.ScaleAwarePointRecord]:
    """All points of a file in its order, at most ``size`` at a time, with the fields needed here.

    COPC is read like any LAZ, through its chunk table: whole, whatever its hierarchy pages.
    """
    fields = laspy.DecompressionSelection
    done = 0
    with (
        open_stream(file) as stream,
        laspy.open(
            stream,
            closefd=False,
            laz_backend=laspy.LazBackend.Lazrs,  # the parallel one takes all cores there are
            read_evlrs=False,
            decompression_selection=fields.XY_RETURNS_CHANNEL
            | fields.Z
            | fields.CLASSIFICATION
            | fields.FLAGS
            | fields.POINT_SOURCE_ID
            | fields.GPS_TIME,
        ) as reader,
    ):
        while done < header.point_count:
            wanted = min(size, header.point_count - done)
            held = f"decoding failed after {done}"
            with _decoding(lambda e, held=held: wrong_count(file, header.point_count, held, e)):
                points = reader.read_points(wanted)
            done += len(points)
            if len(points) < wanted:
                raise wrong_count(file, header.point_count, f"{done} were read")
            yield points


def is_outside_sampled(file: Path, header: laspy.LasHeader) -> bool:
    """Whether one of some points all over the file lies outside of the header's bounds.

    They are the first ones of chunks, so that little is decoded.
    """
    low, high = np.asarray(header.mins), np.asarray(header.maxs)
    slack = 2 * np.asarray(header.scales)
    places = np.linspace(0, header.point_count, SAMPLES, endpoint=False).astype(np.int64)
    with (
        _decoding(lambda e: wrong_count(file, header.point_count, "decoding failed", e)),
        open_stream(file, GLANCE_BYTES) as stream,
        laspy.open(
            stream, closefd=False, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False
        ) as reader,
    ):
        for place in np.unique(places // LAZ_CHUNK * LAZ_CHUNK).tolist():
            reader.seek(place)
            point = reader.read_points(1)
            xyz = np.stack([np.asarray(point[axis]) for axis in "xyz"], axis=1)
            if ((xyz < low - slack) | (xyz > high + slack)).any():
                return True
    return False


def _no_limits() -> np.ndarray:
    return np.array([[np.iinfo(np.int64).max] * 3, [np.iinfo(np.int64).min] * 3])


@dataclass
class PointTally:
    """What is counted and checked along the way; nothing in it depends on the chunks."""

    counts: Integers = field(default_factory=lambda: np.zeros((2, 257), np.int64))  # see _unpack
    by_return: Integers = field(default_factory=lambda: np.zeros(16, np.int64))  # of all points
    file_limits: Integers = field(default_factory=_no_limits)  # [2, 3], stored integers
    lattice_limits: Integers = field(default_factory=_no_limits)  # [2, 3], kept points
    sample: list[np.ndarray] = field(default_factory=list)
    sampled: int = 0
    days: GpsDays = field(default_factory=GpsDays)  # of all points, where they tell them
    strips: StripCodes = field(default_factory=StripCodes)
    synthetic: int = 0  # of all points: made by somebody, not measured

    def take(
        self,
        points: laspy.ScaleAwarePointRecord,
        header: laspy.LasHeader,
        drop_classes: Sequence[int],
    ) -> tuple[Floats, NDArray[np.uint32], NDArray[np.uint32]]:
        """Coordinates [3, n], attributes [n], see _unpack, and codes of strips [n] of the points to
        keep."""
        unwanted = np.isin(np.arange(256), drop_classes)
        raw = np.frombuffer(points.array, np.uint8).reshape(len(points), -1)
        xyz, attributes = np.empty((3, len(points))), np.zeros((2, len(points)), np.uint32)
        if has_days(header):
            self.days.take(points, attributes[0])
        attributes[1] = self.strips.take(points)
        extended = header.point_format.id >= 6
        bit = 1 if extended else 32  # of the flags in LAS 1.4, and of the class byte before
        self.synthetic += int(np.count_nonzero(raw[:, 15] & bit))
        kept = _unpack(
            raw,
            extended,
            unwanted,
            np.asarray(header.scales, np.float64),
            np.asarray(header.offsets, np.float64),
            xyz,
            attributes,
            self.counts,
            self.by_return,
            self.file_limits,
        )
        return xyz[:, :kept], attributes[0, :kept], attributes[1, :kept]

    @property
    def read(self) -> int:
        """Points read, dropped ones included."""
        return int(self.counts.sum())

    @property
    def kept(self) -> int:
        """Points read that were not dropped."""
        return int(self.counts[0].sum())

    def widen(self, lattice: Integers) -> None:
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
        scale = np.asarray(header.scales)
        mins, maxs = np.asarray(header.mins), np.asarray(header.maxs)
        size = maxs - mins
        if not (np.isfinite(size).all() and size.max() > 0):
            return None  # never filled in
        low, high = self.extent(header)
        beyond = np.maximum(mins - low, high - maxs)
        if (beyond <= 2 * scale).all():
            return None
        text = (
            f"points reach from {_triple(low)} to {_triple(high)}, "
            f"the header says from {_triple(mins)} to {_triple(maxs)}"
        )
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
        text = f"the header counts {_counts(stated)} points by return, {_counts(read)} were read"
        if stated[0] == header.point_count:
            return text
        raise InputError(f"truncated or damaged: {text}", file=file, remedy=_ANEW)

    def look(self, lattice: Integers) -> None:
        """Keep the first points for :meth:`refuse_quantised`."""
        if (missing := SAMPLE_POINTS - self.sampled) > 0:
            # 32 bits each: 4.3 degrees, more than a file covers
            low = lattice[:2, :missing] & 0xFFFFFFFF
            self.sample.append(low[0] << 32 | low[1])
            self.sampled += len(self.sample[-1])

    def refuse_quantised(self, file: Path) -> None:
        """InputError if the file's first points share few positions."""
        if not self.sample:
            return
        sample = np.sort(np.concatenate(self.sample))  # np.unique takes ten times as long
        positions = 1 + np.count_nonzero(np.diff(sample))
        if len(sample) >= 1000 and positions < 0.1 * len(sample):
            raise InputError(
                f"coordinates are quantised: {len(sample)} points lie on {positions} positions",
                file=file,
                remedy="write the file again with a finer scale (0.01 m, or 1e-7 degree)",
            )


# Kernels free the GIL; nothing in them depends on how the points are cut into chunks.
@inner
def _integer(raw: Bytes, i: int, at: int) -> int:
    value = np.int64(raw[i, at]) | np.int64(raw[i, at + 1]) << 8
    value |= np.int64(raw[i, at + 2]) << 16 | np.int64(raw[i, at + 3]) << 24
    return np.int64(np.int32(value))


@kernel
def _unpack(
    raw: Bytes,
    extended: bool,
    unwanted: NDArray[np.bool_],
    scale: Floats,
    offset: Floats,
    xyz: Floats,
    attributes: NDArray[np.uint32],
    counts: Integers,
    by_return: Integers,
    limits: Integers,
) -> int:
    """Fill ``xyz`` [3, n] and ``attributes`` [2, n] with the points to keep; returns their number.

    ``raw`` [n, size] are point data records; ``extended``: of formats 6 to 10. The places of fields
    in them are those of LAS 1.4 R16, "Point Data Record Format 0" and "6". ``unwanted`` [256] by
    class. Attributes are class + 256 return number + 2**16 number of returns + 2**20 code of the
    day, and codes of the strip; of all points, ``attributes`` have the code of the day and these.
    ``counts`` [2, 257]: of kept and of dropped points by class, the last of withheld ones;
    ``by_return`` [16]: of all points by return number. ``limits`` [2, 3]: lowest and highest stored
    coordinates of all.
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
        xyz[0, kept] = x * scale[0] + offset[0]
        xyz[1, kept] = y * scale[1] + offset[1]
        xyz[2, kept] = z * scale[2] + offset[2]
        attributes[0, kept] = kind | returns | np.int64(attributes[0, i]) << 20
        attributes[1, kept] = attributes[1, i]
        kept += 1 - drop
    limits[0] = low_x, low_y, low_z
    limits[1] = high_x, high_y, high_z
    return kept


def _counts(values: Integers) -> str:
    return ", ".join(map(str, np.trim_zeros(values, "b").tolist()))


def _triple(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"
