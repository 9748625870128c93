"""LiDAR files to spatially ordered point stores, and what their headers say without their points.

Every point lies on one global lattice (:mod:`.lattice`), so that nothing later depends on the order
of files or points. The store of a file is the same to the byte whatever the size of the reading
chunks; of a footprint, it is the file's own store without the other cells. Its files: see
:mod:`.point_store`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import laspy
import numpy as np

from ..core.errors import InputError
from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.geometry import DEGREE_M
from ..core.products.files import atomic_folder
from ..core.products.remote_files import url_of
from .cell_sort import SCRATCH_POINTS, SortedRuns, bounds_of
from .frames import Epochs
from .lattice import CELL_BITS, LATTICE_DEG, LATTICE_M, PER_DEG, PER_M, Box, Footprint
from .octree import Touches
from .point_fields import BY_CATALOGUE, DAY_CODES, NO_LIMITS, PointTally, not_told_apart
from .point_files import Part, PointFile, open_points
from .point_store import ARRAYS, FORMAT
from .to_wgs84 import ToWGS84, area_of, check_area, to_wgs84

log = logging.getLogger("stereotruth")
logging.getLogger("laspy").addHandler(logging.NullHandler())  # its remarks name no file

NOISE_CLASSES = (7, 18)  # low, high
COARSEST_STEP_M = 0.5  # coordinates stored in coarser steps are refused: a pixel is 0.3-1 m
COARSEST_CELL_M = 30.0  # of a surface model
MARKED_SHARE = 1e-3  # of points that are marked as synthetic, beyond which labels are in doubt
FARTHEST_M = 2e5  # heights beyond are no heights


@dataclass(frozen=True)
class SurveyedFile:
    """A LiDAR file by its header.

    ``box``: lon_min, lat_min, lon_max, lat_max (degrees) and ``heights`` lowest and highest
    (ellipsoidal m) of its points, None where the header states no bounds. ``system`` names the
    coordinate system, ``surface`` what the heights count from; ``notes`` are remarks for the user.
    ``read``: points and bytes that a run reads of it, of ``points`` and ``bytes``.
    """

    path: Path
    points: int
    box: Box | None
    heights: tuple[float, float] | None
    system: str
    surface: str
    notes: tuple[str, ...]
    bytes: int
    read: tuple[int, int]

    @property
    def area_m2(self) -> float:
        """Of the box; 0 without one."""
        if self.box is None:
            return 0.0
        west, south, east, north = self.box
        narrow = np.cos(np.radians((south + north) / 2))
        return float((east - west) * narrow * (north - south)) * DEGREE_M**2


def survey(
    file: str | Path,
    *,
    footprint: Footprint | None = None,
    lidar_crs: str | None = None,
    geoid: str | Path | None = None,
    epochs: Epochs | None = None,
) -> SurveyedFile:
    """A LiDAR file as :func:`ingest` will take it, from its header and layout alone.

    Of an octree that is read by a footprint, the hierarchy is read as well; of files on the disk,
    the heads of their chunks.

    Raises the InputErrors of ingest that need no points.
    """
    file = Path(file)
    points = open_points(file, by_nodes=footprint is not None, layers=url_of(file) is None)
    header = points.header
    how = {"lidar_crs": lidar_crs, "geoid": geoid, "epochs": epochs}
    transform = to_wgs84(header, file, declared=points.declared, **how)
    _refuse_coarse(points, transform)
    part = points.part(_touching(transform, footprint))
    notes = [*transform.notes, *filter(None, (part.remark, points.remark))]
    low, high = points.heights or (np.nan, np.nan)
    mins, maxs = np.array([*header.mins[:2], low]), np.array([*header.maxs[:2], high])
    box = heights = None
    if np.isfinite([mins, maxs]).all() and (maxs >= mins).all() and (maxs > mins).any():
        limits = NO_LIMITS.copy()
        axes = (np.linspace(low, high, 3) for low, high in zip(mins, maxs))
        nodes = np.stack([axis.ravel() for axis in np.meshgrid(*axes)])
        _to_lattice(transform, nodes, limits, file)
        bounds = bounds_of(limits)
        box, heights = tuple(bounds[:4]), tuple(bounds[4:])
        if remark := check_area(transform.system, (box[0], box[2]), (box[1], box[3]), file):
            notes.append(remark)
    else:
        notes.append("its header states no bounds: where its points lie is not known before a run")
    return SurveyedFile(
        path=file,
        points=int(header.point_count),
        box=box,
        heights=heights,
        system=transform.system.name,
        surface=transform.heights,
        notes=tuple(notes),
        bytes=points.bytes,
        read=(part.points, part.bytes),
    )


def ingest(
    lidar_file: str | Path,
    store: str | Path,
    *,
    footprint: Footprint | None = None,
    lidar_crs: str | None = None,
    geoid: str | Path | None = None,
    epochs: Epochs | None = None,
    acquired: Sequence[str] = (),
    drop_classes: Sequence[int] = NOISE_CLASSES,
    provenance: Mapping[str, Any] | None = None,
    chunk_points: int = 100_000,
) -> dict[str, Any]:
    """Bring one file of points, or a surface model, into a point store.

    Memory is that of a reading chunk and :data:`.cell_sort.SCRATCH_POINTS`, whatever the size of
    the file; where it has more points, the others pass through a scratch file without a name, 16
    bytes each, on the disk of the store.

    Withheld points are dropped, and those of ``drop_classes``. Synthetic points, overlap points and
    producers' own classes (65 and 67 mark artefacts in IGN's files) are kept unless listed.
    ``lidar_crs`` (EPSG or WKT), ``geoid`` (path of a grid): see :mod:`.to_wgs84`; ``epochs``: see
    :mod:`.frames`. ``footprint``: the ground whose points are kept; of octrees just the nodes that
    touch it are read, other files whole or not at all (:mod:`.point_files`). ``acquired``: first
    and last day (ISO) by a catalogue, for files whose points do not tell them.

    Returns what is also in the store's attributes: ``points`` (header, read, outside of the
    footprint, kept, dropped by reason), ``nodes`` of an octree and ``bytes`` (read, all),
    ``classes`` (points read by class), ``bounds`` (lon_min, lat_min, lon_max, lat_max in
    degrees, h_min, h_max in m; of no point: where all points of the file are about), ``crs``,
    ``footprint`` (runs of cells, or None), ``acquired`` (first and last day of all points read, and
    what tells them), ``days`` that points tell themselves (of more than DAY_CODES none), ``strips``
    (what tells them, points by code), ``notes`` and ``doubts`` (remarks, which are logged too;
    doubts change what labels are worth).

    Raises InputError: missing, empty, truncated or unreadable file; no usable coordinate system;
    orthometric heights without a geoid; points off the geoid grid, off the Earth or far outside the
    area of the coordinate system; coordinates quantised too coarsely; all points dropped.
    """
    file = Path(lidar_file)
    points = open_points(file, by_nodes=footprint is not None)
    header = points.header

    def transform_of(extent: Floats | None) -> ToWGS84:
        how = {"lidar_crs": lidar_crs, "geoid": geoid, "epochs": epochs}
        return to_wgs84(header, file, extent=extent, declared=points.declared, **how)

    transform = transform_of(None)
    _refuse_coarse(points, transform)
    part = points.part(_touching(transform, footprint))
    with atomic_folder(store) as unfinished, TemporaryFile(dir=unfinished.parent) as disk:
        reading = (footprint, drop_classes, chunk_points, disk)
        tally, runs = _read(points, part, transform, *reading)
        dropped = tally.dropped(drop_classes)
        is_whole = part.points == header.point_count
        if part.points and not tally.kept and is_whole:
            raise InputError(
                f"no point is left of {tally.read}: {_listed(dropped)}",
                file=file,
                remedy="remove the file, or drop fewer classes",
            )
        extent = _extent(header, tally, is_whole)
        if transform.area != area_of(transform.system.horizontal, extent):
            operation, transform = transform.operation, transform_of(extent)
            if transform.operation != operation:  # the header's box led elsewhere
                part = points.part(_touching(transform, footprint))
                is_whole = part.points == header.point_count
                tally, runs = _read(points, part, transform, *reading)
        tally.refuse_quantised(file)
        bounds = (
            bounds_of(tally.lattice_limits) if runs.written else _about(transform, points, extent)
        )
        told_by, bit, by_code = tally.strips
        days = tally.days
        summary = {
            "points": {
                "header": header.point_count,
                "read": tally.read,
                "outside": tally.kept - runs.written,
                "kept": runs.written,
                "dropped": dropped,
            },
            "nodes": part.nodes,
            "bytes": [part.bytes, points.bytes],
            "classes": {str(c): int(n) for c, n in enumerate(tally.counts[0]) if n},
            "bounds": bounds,
            "crs": transform.describe(),
            "footprint": None if footprint is None else footprint.runs,
            "acquired": _acquired(days, acquired),
            "days": days if len(days) <= DAY_CODES else [],
            "strips": {"by": told_by, "points": by_code},
            "notes": _notes(points, part, transform, tally, bounds),
            "doubts": _doubts(tally, file),
        }
        about = {**_head(file), **summary, "provenance": dict(provenance or {})}
        runs.write(unfinished, about, bit if len(by_code) > 1 else None)
        summary["strips"] = about["strips"]
    _tell(file, summary, transform)
    return summary


def _refuse_coarse(points: PointFile, transform: ToWGS84) -> None:
    step, unit_m = float(max(points.header.scales[:2])), transform.system.horizontal_unit_m
    if points.cell * unit_m > COARSEST_CELL_M:
        raise InputError(
            f"a surface model of cells of {points.cell * unit_m:.4g} m",
            file=points.path,
            remedy=f"give one of cells of {COARSEST_CELL_M:g} m at most; 1 m and less are good",
        )
    if not points.cell and step * unit_m > COARSEST_STEP_M:
        raise InputError(
            f"coordinates are stored in steps of {step:g}, {step * unit_m:.4g} m on the ground",
            file=points.path,
            remedy="write the file again with a finer scale (0.01 m, or 1e-7 degree)",
        )


def _touching(transform: ToWGS84, footprint: Footprint | None) -> Touches | None:
    """Which boxes in a file's system may hold points of a footprint; None: all are wanted."""
    if footprint is None:
        return None

    def touch(low: Floats, high: Floats) -> Bools:
        boxes = transform.ground_boxes(low, high)
        unknown = ~np.isfinite(boxes).all(axis=1)
        return footprint.touches(np.where(unknown[:, None], 0.0, boxes)) | unknown

    return touch


@kernel
def _round(lon: Floats, lat: Floats, height: Floats, out: Ints, limits: Ints) -> bool:
    """Fill ``out`` [3, n] with lattice coordinates and widen ``limits`` [2, 3] by them.

    False if there is a point that has no place on Earth; then ``out`` is not whole.
    """
    for k, (values, steps, farthest) in enumerate(
        ((lon, PER_DEG, np.inf), (lat, PER_DEG, np.inf), (height, PER_M, FARTHEST_M))
    ):
        good = True
        low, high = limits[0, k], limits[1, k]
        for i in range(values.size):
            good &= abs(values[i]) < farthest
            q = np.int64(np.rint(values[i] * steps))
            low, high = min(low, q), max(high, q)
            out[k, i] = q
        if not good:
            return False
        limits[0, k], limits[1, k] = low, high
    return True


def _to_lattice(transform: ToWGS84, xyz: Floats, limits: Ints, file: Path) -> Ints:
    """Lattice longitude, latitude, height (int64[3, n]) of file coordinates; widens ``limits``."""
    try:
        lon, lat, height = transform(*xyz)
    except InputError as error:  # of the geoid grid, which does not know the file
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    out = np.empty(xyz.shape, np.int64)
    if not _round(lon, lat, height, out, limits):
        good = np.isfinite(lon) & np.isfinite(lat) & (np.abs(height) < FARTHEST_M)
        bad = np.flatnonzero(~good)
        raise InputError(
            f"{bad.size} points have no place on Earth in '{transform.system.name}', the first at "
            "({:.3f}, {:.3f}, {:.3f})".format(*xyz[:, bad[0]]),
            file=file,
            remedy="correct lidar_crs or the file's coordinate system, or remove these points",
        )
    return out


def _read(
    points: PointFile,
    part: Part,
    transform: ToWGS84,
    footprint: Footprint | None,
    drop_classes: Sequence[int],
    chunk_points: int,
    disk: BinaryIO,
) -> tuple[PointTally, SortedRuns]:
    """The points of a part that lie in a footprint, sorted by cell; ``disk`` is their scratch."""
    file, header = points.path, points.header
    tally = PointTally()
    runs = SortedRuns.of(min(SCRATCH_POINTS, part.points), disk)
    units_m = transform.system.horizontal_unit_m, transform.system.height_unit_m
    for chunk in _bytes_read(part.chunks(chunk_points), part, file.name):
        xyz, attributes, strips = tally.take(chunk, header, drop_classes)
        tally.compare_bounds(header, units_m, file)
        limits = tally.lattice_limits if footprint is None else tally.lattice_limits.copy()
        lattice = _to_lattice(transform, xyz, limits, file)
        tally.sample(lattice)
        if footprint is not None:
            inside = footprint.contains(lattice)
            lattice, attributes, strips = lattice[:, inside], attributes[inside], strips[inside]
            tally.widen(lattice)
        tally.count_strips(strips)
        runs.add(lattice, attributes, strips)
    return tally, runs


def _bytes_read(
    chunks: Iterator[laspy.ScaleAwarePointRecord], part: Part, name: str
) -> Iterator[laspy.ScaleAwarePointRecord]:
    """Pass chunks through and log about every tenth of the bytes."""
    done, last = 0, -1
    for chunk in chunks:
        yield chunk
        done += len(chunk)
        tenth = done * 10 // max(part.points, 1)
        if tenth > last:
            last = tenth
            read = part.bytes * done / part.points
            log.info("%s: %.1f of %.1f MB read", name, read / 1e6, part.bytes / 1e6)


def _extent(header: laspy.LasHeader, tally: PointTally, is_whole: bool) -> Floats:
    """Lowest and highest coordinates [2, 3] of the points of a file.

    Of one that is read in part, those that its header states, unless points contradict them.
    """
    stated = np.array([header.mins, header.maxs], np.float64)
    if not tally.read:
        return stated
    own = tally.extent(header)
    slack = 2 * np.asarray(header.scales)
    agrees = (own[0] >= stated[0] - slack).all() and (own[1] <= stated[1] + slack).all()
    return stated if agrees and not is_whole else own


def _about(transform: ToWGS84, points: PointFile, extent: Floats) -> list[float]:
    """Bounds of a file of which no point is kept, by its lowest and highest coordinates.

    Without the geoid, which need not reach there.
    """
    box = np.nan_to_num(transform.ground_boxes(extent[:1], extent[1:])[0])
    heights = np.array(points.heights or (0.0, 0.0)) * transform.system.height_unit_m
    return [*box.tolist(), *np.nan_to_num(heights).tolist()]


def _head(file: Path) -> dict[str, Any]:
    """The first attributes of a store."""
    return {
        "kind": "points",
        "format": FORMAT,
        "conventions": "WGS 84 longitude and latitude, ellipsoidal height, on the lattice "
        f"of {LATTICE_DEG:g} degree and {LATTICE_M:g} m; cells of 2**{CELL_BITS} steps, "
        "row-major; the order of the file inside a cell",
        "arrays": ARRAYS,
        "source": file.name,
        "cell_bits": CELL_BITS,
        "cells_crc32": None,
    }


def _acquired(days: Sequence[str], stated: Sequence[str]) -> dict[str, str] | None:
    """First and last day of a file's points, by their times, or else as a catalogue states them."""
    if days:
        return {"start": days[0], "end": days[-1], "by": "GPS time of the points"}
    return {"start": stated[0], "end": stated[-1], "by": BY_CATALOGUE} if stated else None


def _notes(
    points: PointFile, part: Part, transform: ToWGS84, tally: PointTally, bounds: Sequence[float]
) -> list[str]:
    """Remarks for the user on a file whose points have been read; they lie within ``bounds``."""
    file, header = points.path, points.header
    units_m = transform.system.horizontal_unit_m, transform.system.height_unit_m
    is_whole = part.points == header.point_count
    remarks = (
        points.remark,
        part.remark,
        tally.compare_bounds(header, units_m, file) if tally.read else None,
        tally.compare_returns(header, file) if is_whole else None,
        check_area(transform.system, (bounds[0], bounds[2]), (bounds[1], bounds[3]), file),
    )
    notes = [*transform.notes, *filter(None, remarks)]
    if same := not_told_apart(tally.days):
        notes.append(f"{len(same)} days of its points cannot be told apart: labels have none there")
    if bounds[4] < -600 or bounds[5] > 9500:
        notes.append(f"heights from {bounds[4]:.1f} to {bounds[5]:.1f} m are implausible")
    return notes


def _doubts(tally: PointTally, file: Path) -> list[str]:
    """What changes the worth of what is made of a file's points."""
    if tally.synthetic <= MARKED_SHARE * tally.read:
        return []
    return [
        f"{tally.synthetic} of {tally.read} points of {file.name} are marked as synthetic: no "
        "pulse was reflected there; remove them (their class in ingest.drop_classes, or pdal) if "
        "they are not of the surface"
    ]


def _tell(file: Path, summary: Mapping[str, Any], transform: ToWGS84) -> None:
    """What was read and kept, in the log."""
    for note in [*summary["notes"], *summary["doubts"]]:
        log.warning("%s: %s", file.name, note)
    points, nodes = summary["points"], summary["nodes"]
    read, every = (count / 1e6 for count in summary["bytes"])
    log.info(
        "%s: %s%.1f of %.1f MB read, %d of %d points",
        file.name,
        f"{nodes[0]} of {nodes[1]} nodes, " if nodes else "",
        read,
        every,
        points["read"],
        points["header"],
    )
    if points["kept"]:
        log.info(
            "%s: %d points kept, %d outside of the footprint (%s); heights %.2f to %.2f m",
            file.name,
            points["kept"],
            points["outside"],
            _listed(points["dropped"]),
            *summary["bounds"][4:],
        )
    else:
        log.info("%s: no point lies in the footprint", file.name)
    log.info("%s: brought to WGS 84 by '%s'", file.name, transform.operation)
    if transform.frame is not None:
        log.info("%s: places are in {frame} at {epoch:.3f}".format_map(transform.frame), file.name)


def _listed(dropped: Mapping[str, int]) -> str:
    return "dropped: " + (
        ", ".join(f"{n} {reason}" for reason, n in dropped.items() if n) or "none"
    )
