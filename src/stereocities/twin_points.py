"""The points of a real place, in the frame of its twin: what they hit, returns, brightness."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pyproj

from stereotruth.core.errors import InputError

from .cities import Twin
from .geodesy import LocalFrame

log = logging.getLogger("stereotruth")

NOISE = (7, 18)  # classes of LAS
POINTS_A_CHUNK = 2_000_000
CLASSED_SHARE = 0.01  # of the points: less of a class, and its class was not looked for
TONE = 2.2  # exponent of the tone curve of colours
MIDDLE = 0.25  # reflectance of a point of median intensity
DARKEST, BRIGHTEST = 0.04, 0.75  # reflectance


class Points(NamedTuple):
    """Points of a place: ``xyz`` float64[n, 3] in the world frame; ``label`` uint8[n]: class of
    LAS; ``single``, ``first`` bool[n]: the only, the first return of its pulse; ``tint``
    float32[n]: reflectance, None where the file tells none."""

    xyz: np.ndarray
    label: np.ndarray
    single: np.ndarray
    first: np.ndarray
    tint: np.ndarray | None

    def which(self, use: np.ndarray) -> Points:
        """The points of a mask or of indices."""
        return Points(*(None if values is None else values[use] for values in self))

    def has_class(self, *labels: int) -> bool:
        """Whether the file tells which points are of these classes."""
        return bool(np.isin(self.label, labels).mean() > CLASSED_SHARE)


class Extent(NamedTuple):
    """Where the points of a file lie: ``crs`` of their plan positions, ``low`` and ``high`` [3] in
    the units of the file, ``unit_m``: metres of a unit of height."""

    crs: pyproj.CRS
    low: np.ndarray
    high: np.ndarray
    unit_m: float

    def to_geodetic(self, xyz: np.ndarray) -> np.ndarray:
        """Longitude, latitude (degrees), height (m) [n, 3] of points [n, 3] of the file."""
        transformer = pyproj.Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)
        lon, lat = transformer.transform(xyz[:, 0], xyz[:, 1])
        return np.column_stack([lon, lat, self.unit_m * xyz[:, 2]])


def extent_of(file: str | Path, crs: str = "") -> Extent:
    """Extent of a LAS or LAZ file by its header. ``crs``: of a file that declares none.

    Raises InputError: no file of points, none in it, or no coordinate system.
    """
    file = Path(file)
    if not file.is_file():
        raise InputError("there is no such file", file=file, remedy="name a LAS or LAZ file")
    try:
        with laspy.open(file) as source:
            header = source.header
            declared = None if crs else header.parse_crs()
    except (laspy.LaspyException, pyproj.exceptions.CRSError, ValueError) as error:
        raise InputError(
            f"cannot be read as LAS or LAZ: {error}", file=file, remedy="name a LAS or LAZ file"
        ) from None
    if not header.point_count:
        raise InputError("has no points", file=file, remedy="name a file of a place's points")
    if not crs and declared is None:
        raise InputError(
            "declares no coordinate system that an EPSG code or WKT names",
            file=file,
            remedy="give the coordinate system of the points, as --crs EPSG:2154",
        )
    try:
        found = pyproj.CRS.from_user_input(crs) if crs else declared
    except pyproj.exceptions.CRSError:
        raise InputError(
            f"{crs!r} is no coordinate system", file=file, remedy="give one as EPSG:2154"
        ) from None
    plan = found.sub_crs_list[0] if found.is_compound else found
    if not (plan.is_projected or plan.is_geographic):
        raise InputError(
            f"the coordinate system {plan.name} has no positions in plan",
            file=file,
            remedy="give the coordinate system of the points, as --crs EPSG:2154",
        )
    axes = found.axis_info
    upward = axes[2] if len(axes) > 2 else axes[0]
    unit = upward.unit_conversion_factor if plan.is_projected or len(axes) > 2 else 1.0
    return Extent(plan.to_2d(), np.array(header.mins), np.array(header.maxs), float(unit))


def read_points(twin: Twin, frame: LocalFrame) -> Points:
    """All points of a place but noise and withheld ones."""
    extent = extent_of(twin.file, twin.crs)
    parts = []
    with laspy.open(twin.file) as source:
        names = set(source.header.point_format.dimension_names)
        for cloud in source.chunk_iterator(POINTS_A_CHUNK):
            label = np.asarray(cloud.classification, np.uint8)
            use = ~np.isin(label, NOISE) & (np.asarray(cloud.withheld) == 0)
            xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[use]
            parts.append((
                frame.from_geodetic(extent.to_geodetic(xyz)),
                label[use],
                np.asarray(cloud.number_of_returns)[use] <= 1,
                np.asarray(cloud.return_number)[use] <= 1,
                np.asarray(cloud.intensity)[use],
                _grey(cloud, names, use),
            ))  # fmt: skip
    xyz, label, single, first, echo, grey = (np.concatenate(of) for of in zip(*parts))
    log.info("%s: %.2f million points", Path(twin.file).name, len(xyz) / 1e6)
    return Points(xyz, label, single, first, _tint(echo, grey))


def _grey(cloud: laspy.ScaleAwarePointRecord, names: set[str], use: np.ndarray) -> np.ndarray:
    """Mean of the colours of points; 0 where a file has none."""
    if not {"red", "green", "blue"} <= names:
        return np.zeros(int(use.sum()), np.float32)
    colours = (np.asarray(cloud[c])[use] for c in ("red", "green", "blue"))
    return (sum(c.astype(np.float32) for c in colours) / 3).astype(np.float32)


def _tint(echo: np.ndarray, grey: np.ndarray) -> np.ndarray | None:
    """Reflectance of points by their colours, else by their intensity, else None."""
    if len(grey) and np.ptp(grey) > 0:
        full = 65535.0 if grey.max() > 255 else 255.0
        return np.clip((grey / full) ** TONE, DARKEST, BRIGHTEST).astype(np.float32)
    if len(echo) and np.ptp(echo) > 0:
        scaled = MIDDLE * echo.astype(np.float64) / max(float(np.median(echo)), 1.0)
        return np.clip(scaled, DARKEST, BRIGHTEST).astype(np.float32)
    return None
