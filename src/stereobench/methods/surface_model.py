"""Disparities to a digital surface model: both rays of each pixel intersected, a GeoTIFF in UTM.

A left pixel (x, y) and its match (x - d, y) of the epipolar grid are brought to the original images
(:class:`stereotruth.epipolar.model.ImageModel`), and the ground point is the one whose projections
by both sensor models lie nearest to the two places, by least squares in px: no polynomial stands
between disparity and height.

Between the points of neighbouring pixels stands a surface of triangles, left open where the
disparity jumps by more than ``MAX_STEP_PX``. A cell of the model holds the highest surface over its
centre, at its centre: unlike the highest point in a cell, that is not too high on slopes, has no
gaps by aliasing, and leaves out pixels that stand alone.

The model is made in blocks, each from the window of the grid that can show it, and kept as
:mod:`stereotruth.core.products.resumable_grids` does, until it is whole and written to the GeoTIFF.
"""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import dask.threaded
import numpy as np
import pyproj
import zarr
from numpy.typing import NDArray
from rasterio.transform import from_origin

from stereotruth.core.errors import InputError
from stereotruth.core.job import block_progress
from stereotruth.core.kernels import inner, kernel
from stereotruth.core.numerics.arrays import Floats
from stereotruth.core.numerics.geometry import Three, plane_slopes, row_span
from stereotruth.core.products.files import atomic_file
from stereotruth.core.products.grids import Layer, blocks, require_complete
from stereotruth.core.products.provenance import digest
from stereotruth.core.products.resumable_grids import BlockStore, resumable_grid
from stereotruth.epipolar.intersection import intersect
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.rpc import SensorModel

log = logging.getLogger("stereotruth")


MAX_STEP_PX = 1.5  # of disparity between neighbours: slopes of 66° with GF-7's 1 px per m
CHUNK = 256
SHARD = 1024  # cells
PART = 512  # px whose points are in memory at a time
SLACK = 2.0  # cells by which a part may reach further than its corners tell
NODATA = -9999.0
LAYERS = {"height": Layer("float32", math.nan, {"units": "m", "long_name": "surface height"})}


@inner
def _triangle(a: Three, b: Three, c: Three, out: NDArray[np.float32]) -> None:
    """Raise ``out`` to the triangle at the cell centres in it; corners (column, row, height)."""
    x, y, z = (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])
    top = max(math.ceil(min(y[0], y[1], y[2])), 0)
    bottom = min(math.floor(max(y[0], y[1], y[2])), out.shape[0] - 1)
    if top > bottom or max(x[0], x[1], x[2]) < 0 or min(x[0], x[1], x[2]) > out.shape[1] - 1:
        return
    along, down = plane_slopes(x, y, z)
    if not np.isfinite(along + down):
        return
    for i in range(top, bottom + 1):
        low, high = row_span(x, y, float(i))
        if not low <= high:
            continue
        left = max(math.ceil(low), 0)
        right = min(math.floor(high), out.shape[1] - 1)
        for j in range(left, right + 1):
            height = np.float32(z[0] + along * (j - x[0]) + down * (i - y[0]))
            if not out[i, j] >= height:
                out[i, j] = height


@kernel
def _surface(
    col: Floats, row: Floats, z: Floats, d: NDArray[np.float32], step: float, out: NDArray
) -> None:
    """Raise ``out`` to the triangles between neighbouring pixels [h, w], where d goes on."""
    for i in range(z.shape[0] - 1):
        for j in range(z.shape[1] - 1):
            p = (col[i, j], row[i, j], z[i, j])
            q = (col[i, j + 1], row[i, j + 1], z[i, j + 1])
            r = (col[i + 1, j], row[i + 1, j], z[i + 1, j])
            s = (col[i + 1, j + 1], row[i + 1, j + 1], z[i + 1, j + 1])
            dp, dq, dr, ds = d[i, j], d[i, j + 1], d[i + 1, j], d[i + 1, j + 1]
            top, bottom = abs(dp - dq) <= step, abs(dr - ds) <= step  # not with NaN
            before, behind = abs(dp - dr) <= step, abs(dq - ds) <= step
            # of the two diagonals the flatter one; the one that is there, if a corner lacks
            falling, rising = abs(dp - ds), abs(dq - dr)
            if falling <= rising or not np.isfinite(rising):
                if top and behind and np.isfinite(p[2] + q[2] + s[2]):
                    _triangle(p, q, s, out)
                if before and bottom and np.isfinite(p[2] + r[2] + s[2]):
                    _triangle(p, r, s, out)
            else:
                if top and before and np.isfinite(p[2] + q[2] + r[2]):
                    _triangle(p, q, r, out)
                if behind and bottom and np.isfinite(q[2] + r[2] + s[2]):
                    _triangle(q, r, s, out)


@dataclass(frozen=True)
class Raster:
    """A north-up grid in UTM: ``west``, ``north`` edge and ``resolution`` in m, ``shape`` cells."""

    epsg: int
    west: float
    north: float
    resolution: float
    shape: tuple[int, int]

    @cached_property
    def from_wgs84(self) -> pyproj.Transformer:
        """(lon, lat) in degrees to (east, north) in m."""
        return pyproj.Transformer.from_crs(4326, self.epsg, always_xy=True)

    def cells(self, lon: Floats, lat: Floats) -> tuple[Floats, Floats]:
        """(column, row) of ground points; whole numbers are centres of cells."""
        flat = self.from_wgs84.transform(lon.ravel(), lat.ravel())
        east, north = (np.reshape(v, lon.shape) for v in flat)
        col = (east - self.west) / self.resolution - 0.5
        return col, (self.north - north) / self.resolution - 0.5

    def ground(self, col: Floats, row: Floats) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees of (column, row): the inverse of :meth:`cells`."""
        east = self.west + (col + 0.5) * self.resolution
        north = self.north - (row + 0.5) * self.resolution
        lon, lat = self.from_wgs84.transform(east, north, direction="INVERSE")
        return np.asarray(lon), np.asarray(lat)


def utm_epsg(lon: float, lat: float) -> int:
    """EPSG code of the UTM zone (WGS 84) of a place, by the plain six-degree zones."""
    zone = min(int((lon + 180.0) % 360.0 // 6.0), 59) + 1
    return (32700 if lat < 0 else 32600) + zone


def gsd(sensor: SensorModel, size: tuple[int, int], height: float) -> float:
    """Mean side of a pixel on the ground in m, in the middle of an image of (cols, rows) px."""
    col, row = (size[0] - 1) / 2, (size[1] - 1) / 2
    lon, lat = sensor.localize([col, col + 1, col], [row, row, row + 1], height)
    utm = pyproj.Transformer.from_crs(4326, utm_epsg(lon[0], lat[0]), always_xy=True)
    east, north = utm.transform(lon, lat)
    sides = np.hypot(np.subtract(east[1:], east[0]), np.subtract(north[1:], north[0]))
    return float(np.sqrt(sides[0] * sides[1]))


def _outline(rows: tuple[float, float], cols: tuple[float, float], n: int = 9) -> Floats:
    """[2, n²] (row, col) over a window, its edges included."""
    mesh = np.meshgrid(np.linspace(*rows, n), np.linspace(*cols, n), indexing="ij")
    return np.stack([axis.ravel() for axis in mesh])


def _ground_at(
    model: EpipolarModel, disparities: tuple[float, float], y: Floats, x: Floats
) -> Floats:
    """[3, n] longitude, latitude, height of whole pixels (y, x), at each of two disparities."""
    found = [
        intersect(model, np.full((1, 1), d, np.float32), int(r), int(c))[:, 0, 0]
        for d in disparities
        for r, c in zip(y, x)
    ]
    return np.transpose(found)


def height_bounds(model: EpipolarModel, low: float, high: float) -> tuple[float, float]:
    """Least and greatest height (m) that disparities between ``low`` and ``high`` px stand for."""
    y, x = _outline((0, model.shape[0] - 1), (0, model.shape[1] - 1), 7)
    found = _ground_at(model, (low, high), y, x)[2]
    if not np.isfinite(found).any():
        raise InputError(
            f"no rays of disparities between {low:g} and {high:g} px meet",
            remedy="run rectify and the prediction again",
        )
    return float(np.nanmin(found)), float(np.nanmax(found))


def raster_of(
    model: EpipolarModel, heights: tuple[float, float], resolution: float | None
) -> Raster:
    """The grid over what the left epipolar grid shows at these heights, on whole multiples.

    ``resolution``: None: the coarser image's pixel on the ground, to two digits.
    """
    if not resolution:
        images = (model.left, model.left_size), (model.right, model.right_size)
        coarse = max(gsd(sensor, size, model.reference_height) for sensor, size in images)
        resolution = float(f"{coarse:.2g}")
    y, x = _outline((0, model.shape[0] - 1), (0, model.shape[1] - 1), 17)
    ground = [model.epipolar_to_ground(x, y, h) for h in heights]
    lon, lat = (np.concatenate(axis) for axis in zip(*ground))
    seen = np.isfinite(lon) & np.isfinite(lat)
    lon, lat = lon[seen], lat[seen]
    epsg = utm_epsg(float(np.median(lon)), float(np.median(lat)))
    east, north = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(lon, lat)
    west, south = (math.floor(np.min(v) / resolution) for v in (east, north))
    right, top = (math.ceil(np.max(v) / resolution) for v in (east, north))
    shape = (top - south, right - west)
    return Raster(epsg, west * resolution, top * resolution, resolution, shape)


def _parts(window: tuple[slice, slice]) -> Iterator[tuple[slice, slice]]:
    """A window in parts of ``PART`` px; neighbours share the row or column between them."""
    starts = (range(s.start // PART * PART, s.stop - 1, PART) for s in window)
    for corner in product(*starts):
        y, x = (
            slice(max(first, s.start), min(first + PART + 1, s.stop))
            for first, s in zip(corner, window)
        )
        yield y, x


@dataclass(frozen=True, eq=False)
class SurfaceModel:
    """What every block needs: plain values, so that it can go to another process."""

    store: Path
    raster: Raster
    heights: tuple[float, float]

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    @cached_property
    def disparity(self) -> zarr.Array:
        """Of the scene, [y, x] in px."""
        return require_complete(self.store)["disparity"]

    @cached_property
    def model(self) -> EpipolarModel:
        """The scene's epipolar model."""
        return EpipolarModel.from_dict(require_complete(self.store).attrs["epipolar"])

    def window(self, rows: slice, cols: slice) -> tuple[slice, slice] | None:
        """[row, col] of the epipolar grid that can show these cells."""
        row, col = _outline((rows.start - 1, rows.stop), (cols.start - 1, cols.stop))
        lon, lat = self.raster.ground(col, row)
        seen = np.hstack([self.model.ground_to_epipolar(lon, lat, h)[:2] for h in self.heights])
        seen = seen[:, np.isfinite(seen).all(axis=0)]
        if not seen.size:
            return None
        low, high = np.floor(seen.min(axis=1)) - 2, np.ceil(seen.max(axis=1)) + 3
        x, y = (
            slice(max(int(a), 0), min(int(b), n))
            for a, b, n in zip(low, high, self.disparity.shape[::-1])
        )
        return (y, x) if y.start < y.stop and x.start < x.stop else None

    def heights_of(self, rows: slice, cols: slice) -> NDArray[np.float32]:
        """Heights of a window of cells, NaN where there is no surface."""
        out = np.full((rows.stop - rows.start, cols.stop - cols.start), np.nan, np.float32)
        window = self.window(rows, cols)
        if window is None:
            return out
        for y, x in _parts(window):
            d = self.disparity[y, x]
            if not self.reaches(d, (y, x), rows, cols):
                continue
            lon, lat, z = intersect(self.model, d, y.start, x.start)
            col, row = self.raster.cells(lon, lat)
            _surface(col - cols.start, row - rows.start, z, d, MAX_STEP_PX, out)
        return out

    def reaches(
        self, d: NDArray[np.float32], part: tuple[slice, slice], rows: slice, cols: slice
    ) -> bool:
        """Whether the surface of a part may lie over these cells, by its own disparities.

        The window is that of all heights of the scene, which one wild disparity makes wide.
        """
        if not np.isfinite(d).any():
            return False
        y, x = _outline(*((s.start, s.stop - 1) for s in part), n=2)
        bounds = float(np.nanmin(d)), float(np.nanmax(d))
        lon, lat, _ = _ground_at(self.model, bounds, y, x)
        if not np.isfinite(lon).all():
            return True
        places = self.raster.cells(lon, lat)
        return all(
            at.max() + SLACK >= window.start and at.min() - SLACK <= window.stop - 1
            for at, window in zip(places, (cols, rows))
        )

    def block(self, out: BlockStore, key: str, rows: slice, cols: slice) -> None:
        """Make one block and write it; its result is the count of cells with a height."""
        found = self.heights_of(rows, cols)
        known = int(np.isfinite(found).sum())
        out.write((rows, cols), key, {"height": found} if known else {}, known)


def write_dsm(
    disparity_store: str | Path,
    out: str | Path,
    *,
    resolution_m: float | None = None,
    workers: int = 1,
    scheduler: Any = dask.threaded.get,
    code: str = "",
    scene: str = "",
) -> dict[str, Any]:
    """Write the surface model of a predicted scene as a GeoTIFF; returns its summary.

    ``disparity_store``: a grid with ``disparity`` and the epipolar model in its attributes, of
    :func:`.predict_scene.predict_scene` or `project`. ``resolution_m``: side of a cell; None: that
    of a pixel of the coarser image on the ground, to two digits. Heights are float32 m above the
    WGS 84 ellipsoid at the centres of the cells, nodata -9999, in the UTM zone of the scene.
    ``scheduler`` is what Dask's compute takes.

    Blocks that an earlier call has left, made of the same, are taken over. Raises InputError for a
    store without disparities or epipolar model.
    """
    store, out = Path(disparity_store).absolute(), Path(out).absolute()
    group = require_complete(store)
    attrs = dict(group.attrs)
    try:
        model = EpipolarModel.from_dict(attrs["epipolar"])
    except (KeyError, TypeError) as error:
        raise InputError(
            "no epipolar model in the attributes", file=store, remedy="run the prediction again"
        ) from error
    heights = height_bounds(model, *_disparity_bounds(group))
    raster = raster_of(model, heights, resolution_m)
    job = SurfaceModel(store, raster, heights)
    content = attrs.get("content") or digest(dict(attrs.get("provenance", {})))
    key = digest(
        {
            "disparity": content,
            "epipolar": attrs["epipolar"],
            "raster": [raster.epsg, raster.west, raster.north, raster.resolution],
            "heights": heights,
            "code": code,
        }
    )
    every = blocks(raster.shape, SHARD)
    with resumable_grid(out, raster.shape, LAYERS, chunk=CHUNK, shard=SHARD) as unfinished:
        missing = unfinished.missing(every, [key] * len(every), workers)
        tasks = [
            dask.delayed(job.block, pure=False)(
                unfinished, key, *every[k], dask_key_name=f"dsm-{k:07d}"
            )
            for k in missing
        ]
        with block_progress(len(tasks), "surface model"):
            dask.compute(*tasks, scheduler=scheduler, num_workers=workers)
        known = sum(unfinished.results(every))
        tags = {
            "scene": scene,
            "long_name": "surface height at the centre of the cell",
            "units": "m",
            "vertical_datum": "WGS 84 ellipsoid",
            "made_of": store.name,
            "content": content,
            "code": code,
        }
        _write_tiff(out, unfinished, raster, tags)
        shutil.rmtree(unfinished.folder, ignore_errors=True)
    summary = {
        "epsg": raster.epsg,
        "resolution_m": raster.resolution,
        "cells": list(raster.shape),
        "known_share": round(known / (raster.shape[0] * raster.shape[1]), 6),
    }
    log.info(
        "surface model of %d x %d cells of %g m (EPSG:%d), %.1f %% with a height",
        *raster.shape,
        raster.resolution,
        raster.epsg,
        100.0 * summary["known_share"],
    )
    return summary


def _disparity_bounds(group: zarr.Group) -> tuple[float, float]:
    """Least and greatest disparity of a grid; of its summary, if it tells."""
    summary = dict(group.attrs.get("summary", {}))
    if "disparity_min_px" in summary:
        return summary["disparity_min_px"], summary["disparity_max_px"]
    if "disparity" not in group:
        raise InputError(
            "no disparities", file=str(group.store_path), remedy="give a predicted or labelled grid"
        )
    disparity = group["disparity"]
    found = [disparity[window] for window in blocks(disparity.shape, SHARD)]
    bounds = [(np.nanmin(v), np.nanmax(v)) for v in found if np.isfinite(v).any()]
    if not bounds:
        raise InputError(
            "no pixel has a disparity", file=str(group.store_path), remedy="run its stage again"
        )
    return float(min(b[0] for b in bounds)), float(max(b[1] for b in bounds))


def _write_tiff(out: Path, made: BlockStore, raster: Raster, tags: dict[str, str]) -> None:
    """The finished blocks as a tiled, compressed GeoTIFF, one tile after the other."""
    import rioxarray  # noqa: F401  (gives arrays the accessor `rio`)
    import xarray as xr  # a quarter of a job's start-up, and the other stages need neither

    store = xr.open_zarr(made.store, consolidated=False, mask_and_scale=False, chunks=None)
    heights = store["height"].drop_vars(["x", "y"])
    # of the band; with Dask's chunks tiles are written twice, and without windows all lie in memory
    heights.attrs = {"long_name": "surface height, m above the WGS 84 ellipsoid"}
    north_west = from_origin(raster.west, raster.north, raster.resolution, raster.resolution)
    heights = heights.rio.write_crs(raster.epsg).rio.write_transform(north_west)
    with atomic_file(out) as scratch:
        heights.rio.write_nodata(NODATA, encoded=True).rio.to_raster(
            scratch,
            windowed=True,
            tags=tags,
            tiled=True,
            blockxsize=CHUNK,
            blockysize=CHUNK,
            compress="deflate",
            predictor=1,  # readers without libtiff know no float predictor
            BIGTIFF="IF_SAFER",
        )
