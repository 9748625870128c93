"""LiDAR files to spatially ordered point stores.

Every point lies on one global lattice: longitude and latitude in steps of 1e-9° (0.1 mm), height in
steps of 1e-4 m. Sums over lattice integers are exact, so that nothing later depends on the order
of files or points. Points are stored by square cells of 2**20 steps (0.00105°, 117 m along a
meridian), cells in row-major order (south to north, west to east), inside a cell in the order of
the file. The store of a file is the same to the byte whatever the size of the reading chunks. Its
files: see :mod:`.point_store`.

What ingest does to a point costs less than half of decoding it: kernels take the records apart,
bring them to the lattice and sort them by cell without an intermediate copy of the points.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..job import progress
from ..kernels import kernel
from ..products.files import atomic_folder, sealed
from .cell_sort import SCRATCH_POINTS, SortedRuns
from .las_files import PointTally, read_ahead
from .lattice import CELL_BITS, LATTICE_DEG, LATTICE_M, PER_DEG, PER_M
from .point_files import PointFile, open_points
from .point_store import ARRAYS, ATTRIBUTES, FORMAT, WORDS
from .to_wgs84 import ToWGS84, area_of, check_area, to_wgs84

log = logging.getLogger("stereotruth")
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


logging.getLogger("laspy").addHandler(logging.NullHandler())  # its remarks name no file
COARSEST_STEP_M = 0.5  # coordinates stored in coarser steps are refused: a pixel is 0.3-1 m
COARSEST_CELL_M = 30.0  # of a surface model
FARTHEST_M = 2e5  # heights beyond are no heights


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


@kernel
def _round(lon: Floats, lat: Floats, height: Floats, out: Integers, limits: Integers) -> bool:
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


def _to_lattice(transform: ToWGS84, xyz: Floats, limits: Integers, file: Path) -> NDArray[np.int64]:
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


def _bounds(low: np.ndarray, high: np.ndarray) -> list[float]:
    return [
        *(float(value) / PER_DEG for value in (low[0], low[1], high[0], high[1])),
        float(low[2]) / PER_M,
        float(high[2]) / PER_M,
    ]


def ingest(
    lidar_file: str | Path,
    store: str | Path,
    *,
    lidar_crs: str | None = None,
    geoid: str | Path | None = None,
    drop_classes: Sequence[int] | None = None,
    scene: str = "",
    provenance: Mapping[str, Any] | None = None,
    chunk_points: int = 100_000,
    workers: int = 1,
) -> dict[str, Any]:
    """Bring one file of points into a point store.

    LAS, LAZ and COPC (1.0 to 1.4, any point format), or a surface model as a GeoTIFF
    (:mod:`.raster_points`).

    Memory is that of a reading chunk and :data:`SCRATCH_POINTS`, whatever the size of the file;
    where it has more points, the others pass through a scratch file without a name, 12 bytes each,
    on the disk of the store.

    Withheld points are dropped, and those of ``drop_classes``: by default (None) those of the
    settings, noise, 7 (low) and 18 (high). Synthetic points, overlap points and producers' own
    classes (65 and 67 mark artefacts in IGN's files) are kept unless listed. Coordinates: see
    :mod:`stereotruth.lidar.to_wgs84`.
    ``lidar_crs`` (EPSG or WKT) and ``geoid`` (path of a grid) as in scenes.tsv; None or "" where
    not needed. With ``workers`` > 1 a thread decodes ahead (the result is the same).

    Returns what is also in the store's attributes: ``points`` (header, read, kept, dropped by
    reason), ``classes`` (kept points by class), ``bounds`` (lon_min, lat_min, lon_max, lat_max in
    degrees, h_min, h_max in m), ``crs`` and ``notes`` (remarks for the user, which are logged too).

    Raises InputError: missing, empty, truncated or unreadable file; no usable coordinate system;
    orthometric heights without a geoid; points off the geoid grid, off the Earth or far outside the
    area of the coordinate system; coordinates quantised too coarsely; no point left.
    """
    if drop_classes is None:
        from .settings import Settings  # a sixth of the start of a job, which knows the classes

        drop_classes = Settings.drop_classes
    file = Path(lidar_file)
    points = open_points(file)
    header = points.header

    def transform_of(extent: Floats | None) -> ToWGS84:
        return to_wgs84(header, file, lidar_crs=lidar_crs, geoid=geoid, extent=extent)

    transform = transform_of(None)
    _refuse_coarse(points, transform)
    with (
        atomic_folder(store) as unfinished,
        TemporaryFile(dir=unfinished.parent) as disk,
    ):
        reading = (drop_classes, chunk_points, workers, disk)
        tally, runs = _read(points, transform, *reading)
        dropped = tally.dropped(drop_classes)
        if runs.written == 0:
            raise InputError(
                f"no point is left of {tally.read}: {_listed(dropped)}",
                file=file,
                remedy="remove the file, or drop fewer classes",
            )
        own = tally.extent(header)
        if transform.area != area_of(transform.system.horizontal, own):
            operation, transform = transform.operation, transform_of(own)
            if transform.operation != operation:  # the header's box led elsewhere
                tally, runs = _read(points, transform, *reading)
        tally.refuse_quantised(file)
        bounds = _bounds(*tally.lattice_limits)
        notes = _notes(points, transform, tally, bounds)
        cells_crc32 = runs.write(unfinished)
        summary = {
            "points": {
                "header": header.point_count,
                "read": tally.read,
                "kept": runs.written,
                "dropped": dropped,
            },
            "classes": {str(c): int(n) for c, n in enumerate(tally.counts[0]) if n},
            "bounds": bounds,
            "crs": transform.describe(),
            "notes": notes,
        }
        about = {"scene": scene, "source": file.name, "cells_crc32": cells_crc32}
        _write_attributes(unfinished, about, summary, dict(provenance or {}))
    for note in notes:
        log.warning("%s: %s", file.name, note)
    log.info(
        "%s: %d of %d points kept (%s); heights %.2f to %.2f m",
        file.name,
        runs.written,
        tally.read,
        _listed(dropped),
        *bounds[4:],
    )
    log.info("%s: brought to WGS 84 by '%s'", file.name, transform.operation)
    return summary


def _notes(
    points: PointFile,
    transform: ToWGS84,
    tally: PointTally,
    bounds: Sequence[float],
) -> list[str]:
    """Remarks for the user on a file whose points have been read; they lie within ``bounds``."""
    file, header = points.path, points.header
    units_m = transform.system.horizontal_unit_m, transform.system.height_unit_m
    lon, lat = (bounds[0], bounds[2]), (bounds[1], bounds[3])
    remarks = (
        points.remark,
        tally.compare_bounds(header, units_m, file),
        tally.compare_returns(header, file),
        check_area(transform.system, lon, lat, file),
    )
    notes = [*transform.notes, *filter(None, remarks)]
    if bounds[4] < -600 or bounds[5] > 9500:
        notes.append(f"heights from {bounds[4]:.1f} to {bounds[5]:.1f} m are implausible")
    return notes


def _write_attributes(
    store: Path, about: Mapping[str, Any], summary: Mapping[str, Any], provenance: Mapping[str, Any]
) -> None:
    """The attributes of a store beside its points; ``about``: scene, source, cells_crc32."""
    attrs = {
        "kind": "points",
        "format": FORMAT,
        "conventions": "WGS 84 longitude and latitude, ellipsoidal height, on the lattice "
        f"of {LATTICE_DEG:g} degree and {LATTICE_M:g} m; cells of 2**{CELL_BITS} steps, "
        "row-major; the order of the file inside a cell",
        "arrays": ARRAYS,
        "scene": about["scene"],
        "source": about["source"],
        "cell_bits": CELL_BITS,
        "cells_crc32": about["cells_crc32"],
        **summary,
        "provenance": provenance,
    }
    (store / ATTRIBUTES).write_text(sealed(attrs), encoding="utf-8")


def _read(
    points: PointFile,
    transform: ToWGS84,
    drop_classes: Sequence[int],
    chunk_points: int,
    workers: int,
    disk: BinaryIO,
) -> tuple[PointTally, SortedRuns]:
    """All points of a file, in runs sorted by cell; ``disk`` is scratch for them."""
    file, header = points.path, points.header
    disk.seek(0)
    disk.truncate()
    tally = PointTally()
    room = min(SCRATCH_POINTS, header.point_count)
    runs = SortedRuns(np.empty((room, WORDS), "<u4"), disk)
    units_m = transform.system.horizontal_unit_m, transform.system.height_unit_m
    chunks = points.chunks(chunk_points)
    if workers > 1:
        chunks = read_ahead(chunks)
    total = -(-header.point_count // chunk_points)
    for chunk in progress(chunks, total, f"{file.name}: chunks of points read"):
        xyz, attributes = tally.take(chunk, header, drop_classes)
        tally.compare_bounds(header, units_m, file)
        lattice = _to_lattice(transform, xyz, tally.lattice_limits, file)
        tally.look(lattice)
        runs.add(lattice, attributes)
    return tally, runs


def _listed(dropped: Mapping[str, int]) -> str:
    return "dropped: " + (
        ", ".join(f"{n} {reason}" for reason, n in dropped.items() if n) or "none"
    )
