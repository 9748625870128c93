"""What a surface model is held against: LiDAR points, or the cells of a reference raster.

Both give points with a place, a height and a kind of surface. Of the points in each square of a
lattice the one nearest to its middle is kept, at its own place: evenly spread, nothing is gridded,
and memory is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from ...core.errors import InputError
from ...lidar.frames import DEFAULT_EPOCHS, Epochs
from ...lidar.height_raster import CLASSES, Floats, HeightRaster
from ...lidar.point_store import PointStore, open_stores, query_points

NONE, GROUND, BUILDING, TREE, WATER, OTHER = range(6)
KIND_OF_CLASS = np.full(256, OTHER, np.uint8)  # of LAS classes
KIND_OF_CLASS[[2, 8]] = GROUND
KIND_OF_CLASS[6] = BUILDING
KIND_OF_CLASS[[3, 4, 5]] = TREE
KIND_OF_CLASS[9] = WATER
KIND_OF_CLASS[[7, 18]] = NONE
WALL_M = 1.5  # that a point on a wall lies below its roof at least
BARE = 0.55  # share of empty squares around that makes a patch, which chance does not
SHADOW_M = 2.5  # around such patches
FINEST_M = 0.5  # side of the lattice's squares at least
SLACK = 1.2  # squares are so much wider than the points' spacing: few are empty


@dataclass(frozen=True)
class Lattice:
    """Reference points on a lattice [h, w]: place (m), height in the model's datum (m), kind.

    Where a square has no point, ``z`` is NaN and ``kind`` NONE. ``step_m``: side of a square;
    rows run north to south, as the raster's do. ``own``: squares that lie in the window asked for,
    without its margin. ``even``: squares with points all around; beside a wall's shadow an edge may
    stand that no point tells.
    """

    x: Floats
    y: Floats
    z: Floats
    kind: NDArray[np.uint8]
    step_m: float
    own: NDArray[np.bool_]
    even: NDArray[np.bool_]


class Reference(Protocol):
    """Where reference points come from."""

    name: str
    classified: bool

    def spacing_m(self, model: HeightRaster) -> float:
        """Distance between neighbouring points, m."""

    def points(
        self, model: HeightRaster, rows: slice, cols: slice
    ) -> tuple[Floats, Floats, Floats, NDArray[np.uint8]]:
        """Places x, y (m), heights (m) and kinds [n] of the points in a window of the model."""


class LidarReference:
    """First returns of point stores; kinds of surface by the classes of LAS."""

    def __init__(self, stores: Sequence[str | Path]) -> None:
        self.stores: tuple[PointStore, ...] = open_stores(stores)
        self.name = ", ".join(store.path.stem for store in self.stores)
        self.classified = True

    def spacing_m(self, model: HeightRaster) -> float:
        """From the number of points in the part of the model that has most."""
        best = 0.0
        side = [max(int(100.0 / step), 8) for step in model.cell_m[::-1]]
        for share in (0.5, 0.3, 0.7):
            rows, cols = (
                slice(int(share * n) - s // 2, int(share * n) + s // 2)
                for n, s in zip(model.shape, side)
            )
            x, _, _, kind = self.points(model, rows, cols)
            dx, dy = model.cell_m
            area = (rows.stop - rows.start) * dy * (cols.stop - cols.start) * dx
            best = max(best, x.size / area)
            self.classified = self.classified and bool(
                np.isin(kind, (GROUND, BUILDING)).any() or not x.size
            )
        if not best:
            raise InputError(
                "no LiDAR point lies in the middle of the surface model",
                file=model.path,
                remedy="give LiDAR of the model's area, and the right coordinate system for both",
            )
        return float(best**-0.5)

    def points(
        self, model: HeightRaster, rows: slice, cols: slice
    ) -> tuple[Floats, Floats, Floats, NDArray[np.uint8]]:
        """First returns that are not noise."""
        found = query_points(self.stores, *model.bounds_wgs84(rows, cols))
        kind = KIND_OF_CLASS[found.classification]
        chosen = (found.return_number <= 1) & (kind != NONE)
        lon, lat, height = (v[chosen] for v in (found.lon, found.lat, found.height))
        x, y = model.places(lon, lat)
        dx, dy = model.cell_m
        inside = (x >= (cols.start - 0.5) * dx) & (x < (cols.stop - 0.5) * dx)
        inside &= (-y >= (rows.start - 0.5) * dy) & (-y < (rows.stop - 0.5) * dy)
        height = height[inside] - model.to_wgs84.height_shift_m(lon[inside], lat[inside])
        return x[inside], y[inside], height, kind[chosen][inside]


class RasterReference:
    """The cells of a reference raster; without ``classes`` all are of one kind, OTHER.

    ``geoid``: of its heights. ``classes``: a raster of LAS classes on the same grid. ``epochs``: of
    the model, see :func:`..score.score_surface_model`.
    """

    def __init__(
        self,
        path: str | Path,
        geoid: str | Path | None = None,
        classes: str | Path | None = None,
        *,
        epochs: Epochs = DEFAULT_EPOCHS,
    ) -> None:
        self.raster = HeightRaster.open(path, geoid, epochs=epochs)
        self.classes = None if classes is None else HeightRaster.open(classes, quantity=CLASSES)
        self.name = Path(path).name
        self.classified = classes is not None
        if self.classes is not None and (
            self.classes.shape != self.raster.shape
            or self.classes.transform != self.raster.transform
        ):
            raise InputError(
                f"another grid than that of {path}", file=classes, remedy="give classes on its grid"
            )

    def spacing_m(self, model: HeightRaster) -> float:
        """The coarser side of its cells."""
        del model
        return max(self.raster.cell_m)

    def points(
        self, model: HeightRaster, rows: slice, cols: slice
    ) -> tuple[Floats, Floats, Floats, NDArray[np.uint8]]:
        """Middles of the cells that have a height."""
        west, south, east, north = model.bounds_wgs84(rows, cols)
        corners = self.raster.places(
            np.array([west, east, west, east]), np.array([south, south, north, north])
        )
        dx, dy = self.raster.cell_m
        across, down = corners[0] / dx, -corners[1] / dy
        window = [
            slice(max(int(v.min()) - 1, 0), min(int(v.max()) + 2, n))
            for v, n in zip((down, across), self.raster.shape)
        ]
        if any(part.stop <= part.start for part in window):
            empty = np.empty(0)
            return empty, empty, empty, np.empty(0, np.uint8)
        heights = self.raster.window(*window)
        known = np.isfinite(heights)
        if self.classes is None:
            kind = np.full(known.sum(), OTHER, np.uint8)
        else:
            of = self.classes.window(*window)[known]
            kind = KIND_OF_CLASS[np.nan_to_num(of).astype(np.uint8)]
        row, col = (at + part.start for at, part in zip(np.nonzero(known), window))
        east, north = self.raster.coordinates(col * dx, -row * dy)
        z = heights[known].astype(np.float64)
        own, other = self.raster.to_wgs84, model.to_wgs84
        if own.describe() == other.describe():
            return (*model.places_of(east, north), z, kind)
        lon, lat, _ = own.exact(east, north, np.zeros(east.size))
        z = z + own.height_shift_m(lon, lat) - other.height_shift_m(lon, lat)
        return (*model.places(lon, lat), z, kind)


def lattice_step(reference: Reference, model: HeightRaster) -> float:
    """Side of the squares, m, at which few are empty."""
    return max(SLACK * reference.spacing_m(model), FINEST_M)


def _evenly(sampled: NDArray[np.bool_], step_m: float) -> NDArray[np.bool_]:
    """Squares without a patch of empty ones within SHADOW_M."""
    bare = uniform_filter((~sampled).astype(np.float64), 5, mode="nearest") > BARE
    return ~maximum_filter(bare, 2 * int(np.ceil(SHADOW_M / step_m)) + 1, mode="nearest")


def _on_walls(z: Floats, kind: NDArray[np.uint8], step_m: float) -> NDArray[np.bool_]:
    """Points of buildings with a roof right above or beside them: a surface model has no walls."""
    built = kind == BUILDING
    top = maximum_filter(np.where(built, z, -np.inf), 3, mode="constant", cval=-np.inf)
    with np.errstate(invalid="ignore"):
        return built & (top - z > max(WALL_M, 2 * step_m * np.tan(np.radians(60.0))))


def lattice_of(
    reference: Reference,
    model: HeightRaster,
    rows: slice,
    cols: slice,
    step_m: float,
    margin_m: float,
) -> Lattice:
    """The reference's points around a window of the model, on the lattice."""
    dx, dy = model.cell_m
    more = [int(np.ceil(margin_m / s)) + 1 for s in (dy, dx)]
    wide = [slice(w.start - m, w.stop + m) for w, m in zip((rows, cols), more)]
    x, y, z, kind = reference.points(model, *wide)
    # squares count from the raster's corner, so that windows share them
    first_col = int(np.floor(wide[1].start * dx / step_m))
    first_row = int(np.floor(wide[0].start * dy / step_m))
    shape = (
        int(np.ceil(wide[0].stop * dy / step_m)) - first_row,
        int(np.ceil(wide[1].stop * dx / step_m)) - first_col,
    )
    col, row = x / step_m - first_col, -y / step_m - first_row
    j, i = np.floor(col).astype(np.int64), np.floor(row).astype(np.int64)
    inside = (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])
    off = np.hypot(col - j - 0.5, row - i - 0.5)
    order = np.argsort(-off[inside], kind="stable")  # the nearest is written last
    chosen = np.flatnonzero(inside)[order]
    at = i[chosen], j[chosen]
    values = [np.full(shape, np.nan) for _ in range(3)]
    kinds = np.zeros(shape, np.uint8)
    for out, of in zip(values, (x, y, z)):
        out[at] = of[chosen]
    kinds[at] = kind[chosen]
    even = _evenly(kinds != NONE, step_m)
    on_wall = _on_walls(values[2], kinds, step_m)
    kinds[on_wall] = NONE
    for out in values:
        out[on_wall] = np.nan
    middle_x = (np.arange(shape[1]) + first_col + 0.5) * step_m
    middle_y = (np.arange(shape[0]) + first_row + 0.5) * step_m  # southwards
    own_cols = (middle_x >= (cols.start - 0.5) * dx) & (middle_x < (cols.stop - 0.5) * dx)
    own_rows = (middle_y >= (rows.start - 0.5) * dy) & (middle_y < (rows.stop - 0.5) * dy)
    return Lattice(*values, kinds, step_m, own_rows[:, None] & own_cols, even)
