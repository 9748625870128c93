"""What the headers of LiDAR files say without their points: how many, where, in which system."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.numerics.geometry import DEGREE_M
from ..core.products.remote_files import url_of
from .footprint import Footprint
from .frames import Epochs
from .ingest import _bounds, _refuse_coarse, _to_lattice, touching
from .point_files import open_points
from .to_wgs84 import check_area, to_wgs84

Box = tuple[float, float, float, float]


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
    """A LiDAR file as :func:`.ingest.ingest` will take it, from its header and layout alone.

    Of an octree that is read by a footprint, the hierarchy is read as well; of files on the disk,
    the heads of their chunks.

    Raises the InputErrors of ingest that need no points: missing, truncated or no LAS; no usable
    coordinate system; orthometric heights without a geoid; bounds off the geoid grid, off the Earth
    or far outside the area of the system; coordinates quantised too coarsely.
    """
    file = Path(file)
    points = open_points(file, by_nodes=footprint is not None, layers=url_of(file) is None)
    header = points.header
    transform = to_wgs84(header, file, lidar_crs=lidar_crs, geoid=geoid, epochs=epochs)
    _refuse_coarse(points, transform)
    part = points.part(touching(transform, footprint))
    notes = [*transform.notes, *([part.remark] if part.remark else [])]
    if remark := points.remark:
        notes.append(remark)
    low, high = points.heights or (np.nan, np.nan)
    mins, maxs = np.array([*header.mins[:2], low]), np.array([*header.maxs[:2], high])
    box = heights = None
    if np.isfinite([mins, maxs]).all() and (maxs >= mins).all() and (maxs > mins).any():
        limits = np.array([[np.iinfo(np.int64).max] * 3, [np.iinfo(np.int64).min] * 3])
        axes = (np.linspace(low, high, 3) for low, high in zip(mins, maxs))
        nodes = np.stack([axis.ravel() for axis in np.meshgrid(*axes)])
        _to_lattice(transform, nodes, limits, file)
        bounds = _bounds(*limits)
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
