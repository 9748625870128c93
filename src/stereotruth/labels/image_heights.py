"""Heights in the geometry of an original image: what each of its pixels shows, by the LiDAR.

One image is enough: of the facets that lie on a pixel's ray, the image shows the highest. The
surface is that of :mod:`stereotruth.surface.surface`, as for the labels of a pair; where an
undecided triangle may be higher on the ray, the pixel has no height, unless the tops of a crown lie
there (:mod:`.crowns`). Multi-view stereo, radiance fields and splatting work on the originals,
which no rectification has touched.

The facets' vertices are projected as (col, row, col - disparity, row), with the disparity that a
height has in the pair of BASE_OVER_HEIGHT, by which all tolerances of the surface count.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..align.alignment import ViewFit
from ..core.errors import InputError
from ..core.job import progress
from ..core.numerics.arrays import Floats, Ints
from ..core.numerics.geometry import DEGREE_M
from ..core.numerics.windows import box_max
from ..core.products.grids import Layer, atomic_store, blocks, create_grid
from ..core.products.provenance import digest
from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..lidar.point_store import VEGETATION_CLASSES, PointStore, open_stores
from ..sensor.pair_geometry import GroundOfImages
from ..sensor.rpc import SensorModel
from ..surface.facet_values import PixelValues
from ..surface.raster import PRISM_IN_LEFT, VISIBLE, ProjectedSurface, SeenSurface
from ..surface.scale import BASE_OVER_HEIGHT, PART
from ..surface.surface_store import SQUARE_BITS, Box, Region, SurfaceStore
from ..surface.vertices import Vertices
from .crowns import HIGHER_PX, HIGHER_REACH, NearestTops
from .view_geometry import PixelScale

log = logging.getLogger("stereotruth")

IMAGE_CHUNK, IMAGE_SHARD = 256, 1024
NO_POINTS, MEASURED, UNDECIDED, CROWN = range(4)
STATUSES = "no_points measured undecided crown"
CROWN_CLASSES = (0, 1, *VEGETATION_CLASSES)  # ASPRS, of what may be a crown; 0, 1: unclassified
# Of the variance that roughness leaves between tops, what it leaves on facets of vegetation, which
# lie within half a pixel of the planes around: 68 to 77 % of the crowns' pixels lie within σ then,
# at 0.5 to 2 points/m² in simulated woods.
ON_FACETS = 0.5
_RISE = 10_000  # lattice steps between two heights, for what one of them changes
LAYERS = {
    "height": Layer("float32", np.nan, {
        "units": "m", "long_name": "height above the WGS 84 ellipsoid of what the pixel's centre "
        "shows", "nodata": "NaN",
    }),
    "lon": Layer("float64", np.nan, {
        "units": "degrees_east", "long_name": "WGS 84 longitude of it", "nodata": "NaN",
    }),
    "lat": Layer("float64", np.nan, {
        "units": "degrees_north", "long_name": "WGS 84 latitude of it", "nodata": "NaN",
    }),
    "sigma": Layer("float32", np.nan, {
        "units": "m", "long_name": "standard uncertainty of the height at the pixel", "nodata":
        "NaN", "formula": "sqrt(v + r + g' C g): v variance of the points' heights in the facet; r "
        "what the roughness of crowns leaves between their points; g slope of the height over the "
        "image, m per px; C covariance of the image's correction, px²",
    }),
    "status": Layer("uint8", 0, {
        "units": "1", "long_name": "why a pixel has a height or none", "flag_values": [0, 1, 2, 3],
        "flag_meanings": STATUSES, "undecided": "a height step may be higher on the pixel's ray",
        "crown": "a rough surface, between the tops of its points: less sure",
    }),
    "surface_class": Layer("uint8", 0, {
        "units": "1", "long_name": "LAS class (ASPRS) of the nearest vertex; 0: never classified",
    }),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ImageInputs:
    """An image, the points of its site and their surface.

    ``sensor`` is corrected; ``fit``: the correction and its covariance, None if it counts as exact;
    ``of_lines`` [2, 2] px²: of what is corrected by line. ``size``: (cols, rows) px.
    """

    sensor: SensorModel
    size: tuple[int, int]
    stores: tuple[PointStore, ...]
    surface: SurfaceStore
    fit: ViewFit | None = None
    of_lines: Floats = field(default_factory=lambda: np.zeros((2, 2)))

    @cached_property
    def reference_m(self) -> float:
        """Height in the middle of the RPC's range."""
        return float(self.sensor.rpc.height_off)

    @property
    def made_of(self) -> dict[str, str]:
        """Digests of the points, for the provenance."""
        return {
            f"points/{store.path.name}": digest(dict(store.attrs.get("provenance", {})))
            for store in self.stores
        }

    @cached_property
    def pixel_m(self) -> float:
        """Side of a pixel on the ground, in the image's middle."""
        return GroundOfImages([self.sensor], [self.size]).pixel_deg[1] * DEGREE_M

    def box(self, rows: slice, cols: slice) -> tuple[float, float, float, float] | None:
        """(west, south, east, north) of all ground that the pixels may show.

        Degrees; None if there are no points.
        """
        heights = (
            min(store.bounds[4] for store in self.stores),
            max(store.bounds[5] for store in self.stores),
        )
        box = None
        for _ in range(2):  # again with the heights of the points that are there
            box = self._box(rows, cols, heights)
            there = [h for store in self.stores if (h := store.height_range(*box)) is not None]
            if not there:
                return None
            heights = min(low for low, _ in there), max(high for _, high in there)
        return box

    def _box(
        self, rows: slice, cols: slice, heights: tuple[float, float]
    ) -> tuple[float, float, float, float]:
        col, row, height = (
            grid.reshape(-1)
            for grid in np.meshgrid(
                np.linspace(cols.start - 1.0, cols.stop, 5),
                np.linspace(rows.start - 1.0, rows.stop, 5),
                heights,
            )
        )
        lon, lat = self.sensor.localize(col, row, height)
        scale = self.surface.scale
        reach = scale.height_reach / PART + 4
        east, north = (reach * side * LATTICE_DEG for side in scale.cell)
        return (
            float(np.nanmin(lon)) - east, float(np.nanmin(lat)) - north,
            float(np.nanmax(lon)) + east, float(np.nanmax(lat)) + north,
        )  # fmt: skip

    @cached_property
    def scale(self) -> PixelScale:
        """Of the pair of BASE_OVER_HEIGHT in whose disparities heights are compared."""
        return PixelScale(BASE_OVER_HEIGHT / self.pixel_m, self.pixel_m, self.surface.scale)

    @property
    def overhang_px(self) -> int:
        """By which a crown's contour may lie beyond its last points: the diagonal of a spacing."""
        return int(np.sqrt(2) * self.scale.spacing_px)

    def with_rise(
        self, lon_q: Ints, lat_q: Ints, h_q: Ints, lifted: NDArray[np.bool_]
    ) -> tuple[Floats, NDArray[np.float32]]:
        """See :class:`stereotruth.surface.raster.Projection`: (col, row, col - disparity, row)."""
        xy = self._project(lon_q, lat_q, h_q)
        rise = np.empty(xy.shape, np.float32)
        higher = self._project(lon_q[lifted], lat_q[lifted], h_q[lifted] + _RISE)
        rise[:, lifted] = (higher - xy[:, lifted]) / _RISE
        return xy, rise

    def _project(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> Floats:
        height = h_q * LATTICE_M
        col, row = self.sensor.project(lon_q * LATTICE_DEG, lat_q * LATTICE_DEG, height)
        disparity = (height - self.reference_m) * self.scale.px_per_m
        return np.stack([col, row, col - disparity, row])

    def covariance(self, rows: slice, cols: slice) -> Floats:
        """[2, 2] px² of the correction in the middle of a block."""
        if self.fit is None:
            return np.zeros((2, 2))
        design = self.fit.design((cols.start + cols.stop) / 2, (rows.start + rows.stop) / 2)
        return design @ self.fit.covariance @ design.T + self.of_lines


def heights_of_block(inputs: ImageInputs, rows: slice, cols: slice) -> dict[str, NDArray] | None:
    """The layers of LAYERS at the pixels of a block; None if no point is near."""
    margin = max(HIGHER_REACH, inputs.overhang_px)
    core, covariance = (slice(margin, -margin),) * 2, inputs.covariance(rows, cols)
    rows, cols = (slice(part.start - margin, part.stop + margin) for part in (rows, cols))
    box = inputs.box(rows, cols)
    blocks = () if box is None else inputs.surface.blocks(box)
    if not blocks:
        return None
    around = inputs.surface.window(blocks)
    surface = around.surface(_region(inputs, around.vertices, box))
    if not surface.vertices.x.size:
        return None
    shape, first = (rows.stop - rows.start, cols.stop - cols.start), (rows.start, cols.start)
    projected = ProjectedSurface.of(surface, inputs, first)
    facets = projected.seen(shape, inputs.scale.px_per_m)
    crowns = _CrownPixels.of(facets, inputs.scale)
    status = np.full(shape, np.uint8(NO_POINTS))
    status[facets.visibility == VISIBLE] = MEASURED
    status[facets.visibility == PRISM_IN_LEFT] = UNDECIDED
    on_crown = np.isin(facets.surface_class, VEGETATION_CLASSES)
    covered = crowns.overhang(facets.disparity, inputs.overhang_px) & ~on_crown
    status[(status == MEASURED) & covered] = UNDECIDED
    status[(status != MEASURED) & crowns.is_nearest] = CROWN
    layers = _layers(inputs, (rows, cols), covariance, status, facets, crowns)
    return {name: np.ascontiguousarray(layer[core]) for name, layer in layers.items()}


@dataclass(frozen=True, eq=False)
class _CrownPixels:
    """What the tops of crowns show in a block, arrays [h, w]: ``is_nearest`` where nothing hides
    them; their ``values``, ``disparity`` (−∞ for none), and the ``variance`` px² of what lies
    between them, NaN for none."""

    is_nearest: NDArray[np.bool_]
    values: PixelValues
    disparity: Floats
    variance: Floats

    @classmethod
    def of(cls, facets: SeenSurface, scale: PixelScale) -> _CrownPixels:
        """In the image in which the ``facets`` are seen."""
        tops = NearestTops.of(facets)
        there = tops.index >= 0
        values = tops.values(there, facets.projected)
        there &= np.isin(values.surface_class, CROWN_CLASSES)
        disparity = np.where(there, tops.disparity, -np.inf)
        variance = tops.variance(there, facets.projected.surface.tops, scale)
        return cls(there & tops.in_front(), values, disparity, variance)

    def overhang(self, disparity: Floats, reach: int) -> NDArray[np.bool_]:
        """Where a crown up to ``reach`` px off is much higher than what shows ``disparity``, NaN
        for nothing."""
        with np.errstate(invalid="ignore"):
            return box_max(self.disparity, reach) > disparity + HIGHER_PX


def _region(inputs: ImageInputs, vertices: Vertices, box: Box) -> Region:
    """The squares of a box (west, south, east, north, degrees) from the vertices' origin on."""
    size = [int(values.max()) >> SQUARE_BITS for values in (vertices.y, vertices.x)]
    squares = np.zeros((size[0] + 1, size[1] + 1), np.bool_)
    part = []
    for low, high, q, at, side in (
        (box[1], box[3], vertices.lat_q[0], vertices.y[0], inputs.surface.scale.cell[1]),
        (box[0], box[2], vertices.lon_q[0], vertices.x[0], inputs.surface.scale.cell[0]),
    ):
        first, last = (
            int(np.floor((edge / LATTICE_DEG - q) / side * PART + at)) >> SQUARE_BITS
            for edge in (low, high)
        )
        part.append(slice(max(first - 1, 0), max(last + 2, 0)))
    squares[part[0], part[1]] = True
    return Region(squares)


def _layers(
    inputs: ImageInputs,
    window: tuple[slice, slice],
    covariance: Floats,
    status: NDArray[np.uint8],
    facets: SeenSurface,
    crowns: _CrownPixels,
) -> dict[str, NDArray]:
    """Layers of a block, from what ``facets`` and ``crowns`` have at its pixels."""
    rows, cols = window
    crown = status == CROWN
    good = crown | (status == MEASURED)
    height = np.where(crown, crowns.values.height * LATTICE_M, facets.height)
    height[~good] = np.nan
    px_per_m = inputs.scale.px_per_m
    slope = np.where(crown, crowns.values.slope, facets.slope) / px_per_m
    moved = np.einsum("ihw,ij,jhw->hw", slope, covariance, slope)
    roughness = np.nan_to_num(crowns.variance) / px_per_m**2
    on_facet = np.where(np.isin(facets.surface_class, VEGETATION_CLASSES), ON_FACETS, 0.0)
    of_points = facets.variance / px_per_m**2 + on_facet * roughness
    sigma = np.sqrt(np.where(crown, roughness, of_points) + moved)
    surface_class = np.where(crown, crowns.values.surface_class, facets.surface_class)
    col, row = np.meshgrid(np.arange(cols.start, cols.stop), np.arange(rows.start, rows.stop))
    lon, lat = np.full(height.shape, np.nan), np.full(height.shape, np.nan)
    lon[good], lat[good] = inputs.sensor.localize(col[good], row[good], height[good])
    return {
        "height": height.astype(np.float32),
        "lon": lon,
        "lat": lat,
        "sigma": np.where(good, sigma, np.nan).astype(np.float32),
        "status": status,
        "surface_class": np.where(good, surface_class, 0).astype(np.uint8),
    }


def write_image_heights(
    inputs: ImageInputs,
    out_zarr: str | Path,
    *,
    image: str = "",
    workers: int = 1,
    provenance: Mapping[str, Any] | None = None,
) -> dict[str, float]:
    """Write the layers of LAYERS on an image's own grid [row, col]; shares of pixels by status.

    Blocks are independent of each other: the bytes are the same for any number of workers and any
    order of the stores. Raises InputError if no pixel of the image has a height.
    """
    shape = inputs.size[1], inputs.size[0]
    attrs = {
        "kind": "image heights",
        "image": image,
        "conventions": "arrays are [row, col] of the original image; pixel (0, 0) is the centre of "
        "the upper-left pixel",
        "sensor": inputs.sensor.to_dict(),
        "provenance": dict(provenance or {}),
    }
    counts = np.zeros(len(STATUSES.split()), np.int64)
    with atomic_store(out_zarr) as scratch, ThreadPoolExecutor(workers) as pool:
        arrays = create_grid(
            scratch,
            shape,
            LAYERS,
            chunk=IMAGE_CHUNK,
            shard=IMAGE_SHARD,
            attrs=attrs,
            of="original image",
        )

        def make(window: tuple[slice, slice]) -> NDArray[np.int64]:
            layers = heights_of_block(inputs, *window)
            if layers is None:
                size = (window[0].stop - window[0].start) * (window[1].stop - window[1].start)
                return np.array([size, *[0] * (counts.size - 1)])
            for name, values in layers.items():
                arrays[name][window] = values
            return np.bincount(layers["status"].reshape(-1), minlength=counts.size)

        windows = blocks(shape, IMAGE_SHARD)
        for part in progress(pool.map(make, windows), len(windows), f"{image}: heights"):
            counts += part
        if not counts[MEASURED] + counts[CROWN]:
            raise InputError(
                f"no pixel of image {image} has a height: no LiDAR lies where it looks",
                file=out_zarr,
                remedy="check the LiDAR's and the image's coordinates",
            )
    shares = counts / counts.sum()
    named = dict(zip(STATUSES.split(), map(float, shares)))
    log.info(
        "%s: %s", image, ", ".join(f"{100 * share:.1f} % {name}" for name, share in named.items())
    )
    return named


def open_inputs(
    sensor: SensorModel,
    size: tuple[int, int],
    point_stores: Sequence[str | Path],
    surface: str | Path,
    fit: ViewFit | None = None,
    of_lines: Floats | None = None,
) -> ImageInputs:
    """Inputs with the stores opened, those of points in the order of their names."""
    stores = open_stores(sorted(map(str, point_stores)))
    lines = np.zeros((2, 2)) if of_lines is None else of_lines
    return ImageInputs(sensor, size, stores, SurfaceStore(surface), fit, lines)
