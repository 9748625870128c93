"""How much of a scene's LiDAR was read, and where what both images show has none."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import corners_of_hull
from ..epipolar.model import EpipolarModel
from ..lidar.lattice import CELL_DEG, Footprint, cell_key
from ..lidar.point_store import PointStore
from ..sensor.pair_geometry import frame, inside
from .scene_inputs import SceneInputs

log = logging.getLogger("stereotruth")
Bools = NDArray[np.bool_]

EDGE = 33  # places along each side of a frame


def lidar_read(inputs: SceneInputs, model: EpipolarModel) -> dict[str, Any]:
    """Record of a scene's LiDAR: what was read of the files, and what is missing.

    ``files`` (with points, all), ``nodes`` (read, all; of octrees), ``points`` and ``bytes`` (read,
    all). ``holes_m2``: ground that both images show in whole cells without a point; ``hole`` (lon,
    lat, degrees): the middle of the largest such place, or None. ``not_read_m2``: ground whose
    points labels may follow from, and which the footprint left out. ``acquired``: first and last
    day of the points, None unless all files tell them; ``doubts`` about the points; ``surfaces``:
    what heights count from, by number of files; ``strips``: what they are off, None of one strip;
    ``frame`` and epoch of the places, and those of the files. What is missing is logged, and files
    of different surfaces.
    """
    attrs = [PointStore(path).attrs for path in inputs.point_stores]
    nodes = [a["nodes"] for a in attrs if a["nodes"]]
    points = [a["points"] for a in attrs]
    holes_m2, hole = _holes(inputs, model)
    if hole is not None:
        log.warning(
            "warning: %.3f km² of what both images show have no LiDAR point, most of it around "
            "longitude %.5f, latitude %.5f",
            holes_m2 / 1e6,
            *hole,
        )
    return {
        "files": [sum(p["kept"] > 0 for p in points), len(points)],
        "nodes": np.sum(nodes, axis=0).tolist() if nodes else None,
        "points": [sum(p[name] for p in points) for name in ("read", "header")],
        "bytes": np.sum([a["bytes"] for a in attrs], axis=0).tolist(),
        "holes_m2": holes_m2,
        "hole": hole,
        "not_read_m2": _not_read(inputs),
        "acquired": _days([a["acquired"] for a in attrs]),
        "doubts": sorted({text for a in attrs for text in a.get("doubts", ())}),
        "surfaces": _surfaces([a["crs"]["heights"] for a in attrs]),
        "strips": inputs.lidar_strips.report() if inputs.lidar_strips else None,
        "frame": _frame([a["crs"].get("frame") for a in attrs]),
    }


def _frame(frames: Sequence[Mapping[str, Any] | None]) -> dict[str, Any] | None:
    """Frame and epoch of the places, and the frames and epochs that files have them in."""
    known = [frame for frame in frames if frame is not None]
    if len(known) < len(frames) or not known:
        return None
    sources = {tuple((k, str(v)) for k, v in f["source"].items()): f["source"] for f in known}
    return {**known[0], "source": [sources[key] for key in sorted(sources)]}


def _days(acquired: Sequence[Mapping[str, str] | None]) -> list[str] | None:
    days = [(one["start"], one["end"]) for one in acquired if one is not None]
    if len(days) < len(acquired) or not days:
        return None
    return [min(first for first, _ in days), max(last for _, last in days)]


def _surfaces(heights: Sequence[str]) -> dict[str, int]:
    """What heights count from, without their units, which are metres by now."""
    counts = Counter(text.rpartition(", in ")[0] for text in heights)
    if len(counts) > 1:
        log.warning(
            "warning: heights of the LiDAR's files count from different surfaces (%s): check them, "
            "or declare them by lidar_crs",
            "; ".join(f"{count}: {text}" for text, count in counts.most_common()),
        )
    return dict(sorted(counts.items()))


def _not_read(inputs: SceneInputs) -> float:
    rows, cols = inputs.pair.model.shape
    area = inputs.windows.beyond_stores(slice(0, rows), inputs.pair.cols(slice(0, cols)))
    if area:
        log.warning(
            "warning: labels may follow from points on %.2f km² around the images that were not "
            "read: the aligned images lie elsewhere than their RPCs say, or points lie far above "
            "the ground. Set ingest.margin_m to more, or to null, to read them",
            area / 1e6,
        )
    return round(area, 1)


def _holes(inputs: SceneInputs, model: EpipolarModel) -> tuple[float, list[float] | None]:
    """Ground (m²) of cells without a point whose middle both images show, and the largest place."""
    ground = np.stack(model.left.localize(*frame(model.left_size, EDGE), model.reference_height))
    ground = ground[:, np.isfinite(ground).all(axis=0)]
    cells = Footprint.around([ground[:, corners_of_hull(*ground)]], 0.0)
    row, col = (at + first for at, first in zip(np.nonzero(cells.held), (cells.row, cells.col)))
    lon, lat = (col + 0.5) * CELL_DEG, (row + 0.5) * CELL_DEG
    missing = np.ones(row.size, np.bool_)
    for sensor, size in ((model.left, model.left_size), (model.right, model.right_size)):
        missing &= inside(np.stack(sensor.project(lon, lat, model.reference_height)), size)
    for store in inputs.stores:
        missing &= ~np.isin(cell_key(row, col), cell_key(store.cell_row, store.cell_col))
    if not missing.any():
        return 0.0, None
    area = cells.cell_m2[row[missing] - cells.row].sum()
    empty = np.zeros(cells.held.shape, np.uint8)
    empty[row[missing] - cells.row, col[missing] - cells.col] = 1
    import cv2  # few scenes have holes

    _, _, sizes, middles = cv2.connectedComponentsWithStats(empty, connectivity=8)
    x, y = middles[1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))]
    hole = (np.array([x + cells.col, y + cells.row]) + 0.5) * CELL_DEG
    return round(float(area), 1), np.round(hole, 5).tolist()
