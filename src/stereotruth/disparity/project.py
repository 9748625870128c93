"""Points to disparity: the stage `project` (paper, section III-C).

Every point is projected into both rectified images; hidden points are removed; what is left of a
pixel of the left epipolar grid is condensed to one label, d = x_left - x_right (px), see
:mod:`stereotruth.disparity.pixel_labels`. A point belongs to the pixel (floor(x_left + 0.5),
floor(y_left + 0.5)).

What is tested, in this order; a pixel has the status of the first test that leaves it nothing, that
of its point that got furthest:

1. of each point: does it lie in both frames; is it on the surface that its pixel's centre sees
   (:func:`.seen_surface.seen_surface`; with the representative ``top`` or geometric
   visibility); do the image windows around it correlate (method ``correlation``: the paper's
   filter, :mod:`stereotruth.disparity.paper_correlation`);
2. of each pixel: do both cameras see it past the other surfaces
   (:func:`.hidden_pixels.hidden_pixels`; ``geometric``, ``both``); is an edge of its surface
   near its centre (``top``); do the images agree with what the LiDAR has there, and is it no water
   (:func:`.image_agreement.outvoted`; ``both``); do its neighbours carry its surface
   (:func:`.image_agreement.supported`; ``geometric``, ``both``); are there ``min_points``.

The grid is worked on in blocks of one shard, each independent of the others; a block is cut into
windows of a bounded number of points. The result has the same bytes for any number of workers, size
of windows, and order of blocks, stores and points.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import dask
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ..alignment.label_uncertainty import LabelUncertainty
from ..epipolar.model import EpipolarModel
from ..epipolar.surface_correlation import surface_correlation
from ..errors import InputError
from ..job import BlockProgress
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from ..lidar.point_store import PointStore
from ..products.grids import Strip, blocks, require_complete
from ..products.provenance import describe, digest, source_digest
from ..products.resumable_grids import BlockStore, making
from .hidden_pixels import FILL_RADII, Rays, Surface, SurfaceBuilder, hidden_pixels
from .image_agreement import outvoted, supported, warp_to_left
from .image_patches import Array2D, Patch, read_patch
from .layers import layers
from .local_projection import LocalProjection
from .overlap_check import apart, refuse_apart
from .paper_correlation import correlate
from .pixel_labels import Labels, Pixels, at_centres, at_points, condense
from .pixel_points import Collection, PixelPoints
from .right_view import MirroredImage, MirroredModel, mirrored
from .seen_surface import seen_surface
from .settings import Settings
from .status import WATER_CLASS, Status

log = logging.getLogger("stereotruth")
Box = tuple[float, float, float, float]
Floats = NDArray[np.float64]


CHUNK = 256
SHARD = 1024
MAX_POINTS = 6_000_000  # expected in a window; some 60 bytes each at the peak
READ_POINTS = 1 << 20  # about as many are read at once,
BLOCK = 1 << 16  # and as many go through the projection, while they are in the cache


class Reach(NamedTuple):
    """Where the points of a window are: box of those that it can show, with their heights (m);
    box of those that can hide these, with the greatest height there."""

    box: Box
    low: float
    high: float
    around: Box
    top: float


@dataclass(frozen=True, eq=False)
class _Scene:
    """What every block needs: plain values, so that it can go to another process."""

    left_store: Path
    right_store: Path
    point_stores: tuple[Path, ...]
    settings: Settings
    max_points: int
    view: str = "left"

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    # The view that gets labels is "left" from here on, see right_view.

    @cached_property
    def images(self) -> tuple[Array2D, Array2D]:
        left, right = (
            require_complete(path)["image"] for path in (self.left_store, self.right_store)
        )
        if self.view == "right":
            return MirroredImage(right), MirroredImage(left)
        return left, right

    @cached_property
    def model(self) -> EpipolarModel | MirroredModel:
        model = EpipolarModel.from_dict(require_complete(self.left_store).attrs["epipolar"])
        return MirroredModel(model) if self.view == "right" else model

    @cached_property
    def stores(self) -> tuple[PointStore, ...]:
        return tuple(PointStore(path) for path in self.point_stores)

    @cached_property
    def rays(self) -> Rays:
        return Rays.of(self.model)

    @cached_property
    def alignment_sigma(self) -> LabelUncertainty:
        return LabelUncertainty.of(require_complete(self.left_store).attrs)

    # -- where the points of a window are

    def ground_box(self, rows: slice, cols: slice, low: float, high: float) -> Box | None:
        """lon, lat box (degrees) of what a window of the left grid can show at these heights."""
        ground = self.outline(rows, cols, low, high)
        if ground.size == 0:
            return None
        (west, south), (east, north) = ground.min(axis=1), ground.max(axis=1)
        # Two pixels more, for the curvature of the edges.
        spare = 4.0 * np.array(self.rays.cell) * LATTICE_DEG
        return west - spare[0], south - spare[1], east + spare[0], north + spare[1]

    def outline(self, rows: slice, cols: slice, low: float, high: float) -> Floats:
        """lon, lat [2, n] (degrees) along the edges of a window and its margin at two heights."""
        margin = self.settings.margin
        x = np.linspace(cols.start - margin - 1.0, cols.stop + margin, 5)
        y = np.linspace(rows.start - margin - 1.0, rows.stop + margin, 5)
        edge_x = np.concatenate([x, x, np.full(5, x[0]), np.full(5, x[-1])])
        edge_y = np.concatenate([np.full(5, y[0]), np.full(5, y[-1]), y, y])
        ground = np.hstack(
            [np.stack(self.model.epipolar_to_ground(edge_x, edge_y, h)) for h in (low, high)]
        )
        return ground[:, np.isfinite(ground).all(axis=0)]

    def heights(self, box: Box) -> tuple[float, float] | None:
        """Lowest and highest point (m) of the stores' cells that a box touches."""
        found = [r for r in (store.height_range(*box) for store in self.stores) if r is not None]
        return (min(r[0] for r in found), max(r[1] for r in found)) if found else None

    def reach(self, rows: slice, cols: slice) -> Reach | None:
        """Of a window; None if there are no points."""
        low = min(store.bounds[4] for store in self.stores)
        top = high = max(store.bounds[5] for store in self.stores)
        box = None
        for _ in range(3):  # heights narrow the box, the box narrows the heights
            box = self.ground_box(rows, cols, low, high)
            found = None if box is None else self.heights(box)
            if found is None:
                return None
            low, high = found
        moves = self.rays.reach(cols, rows)
        spare = self.spare
        around = box
        for _ in range(3):
            rise = top - low
            around = (
                box[0] + moves[0, 0] * rise - spare[0],
                box[1] + moves[1, 0] * rise - spare[1],
                box[2] + moves[0, 1] * rise + spare[0],
                box[3] + moves[1, 1] * rise + spare[1],
            )
            top = self.heights(around)[1]
        return Reach(box, low, high, around, top)

    @property
    def spare(self) -> Floats:
        """Degrees (lon, lat) around the ground that a window needs: holes are filled from there."""
        return (sum(FILL_RADII) + 2.0) * np.array(self.rays.cell) * LATTICE_DEG

    def strips(self, rows: slice, cols: slice, reach: Reach) -> list[Box]:
        """Boxes, one for some rows of cells of the stores each, of the points a window needs.

        They cover the hull of what it can show and of the tracks of the rays from there. A box
        around the hull of a turned image would hold up to twice as many points.
        """
        ground = self.outline(rows, cols, reach.low, reach.high)
        box = reach.box
        if self.settings.uses_geometry:
            box = reach.around
            corners = np.array(
                [[1.0, x, y] for x in (cols.start, cols.stop) for y in (rows.start, rows.stop)]
            )
            moves = np.hstack([*(self.rays.track @ corners.T), np.zeros((2, 1))])
            moves *= reach.top - reach.low
            ground = (ground[:, :, None] + moves[:, None]).reshape(2, -1)
        hull = ground[:, ConvexHull(ground.T).vertices]
        after = np.roll(hull, -1, axis=1)
        rise = after[1] - hull[1]
        slope = (after[0] - hull[0]) / np.where(rise == 0.0, np.inf, rise)
        spare = self.spare
        side = LATTICE_DEG * (1 << CELL_BITS)
        first, last = (int(np.floor(edge / side)) for edge in (box[1], box[3]))
        step = max(round(READ_POINTS / max(self.expected([box]), 1.0) * (last + 1 - first)), 1)
        found = []
        for row in range(first, last + 1, step):
            # Half a step below the border, so that no point lies on it.
            south, north = (
                np.clip(edge * side - 0.5 * LATTICE_DEG, box[1], box[3])
                for edge in (row, row + step)
            )
            # Where the sides of the hull, cut off at the strip's borders, begin and end.
            ends = np.clip([hull[1], after[1]], south - spare[1], north + spare[1])
            lon = hull[0] + slope * (ends - hull[1])
            touched = np.ptp(ends, axis=0) > 0.0
            if touched.any():
                west, east = lon[:, touched].min(), lon[:, touched].max()
                found.append((west - spare[0], south, east + spare[0], north))
        return found

    def expected(self, boxes: Sequence[Box]) -> float:
        """About how many points lie in boxes, if the stores are evenly filled."""
        total = 0.0
        for store in self.stores:
            west, south, east, north = store.bounds[:4]
            for box in boxes:
                share = 1.0
                for a, b, low, high in (
                    (box[0], box[2], west, east),
                    (box[1], box[3], south, north),
                ):
                    share *= max(min(b, high) - max(a, low), 0.0) / max(high - low, 1e-12)
                total += store.count * share
        return total

    # -- one window

    def label(self, rows: slice, cols: slice) -> tuple[dict[str, NDArray], NDArray] | None:
        """All layers of a window and its point counts; None if it has no points.

        Counts: points in the window, in both frames, used.
        """
        reach = self.reach(rows, cols)
        if reach is None:
            return None
        settings, margin = self.settings, self.settings.margin
        wide = (
            slice(rows.start - margin, rows.stop + margin),
            slice(cols.start - margin, cols.stop + margin),
        )
        left, right = self.patches(wide, reach)
        found = self.collect(self.strips(rows, cols, reach), wide, left, right)
        if found is None:
            return None
        points, local, surface = found
        use, edge = np.ones(points.points.size, dtype=np.bool_), None
        if settings.uses_seen_surface:
            use, edge = seen_surface(points, settings.edge_margin_px)
        seen, correlation = use, None
        if settings.method == "correlation":
            correlation = correlate(points, use, left, right, settings.window)
            use = use & (correlation >= settings.correlation_threshold)
        pixels = condense(self.model, local, points, use, correlation, settings.representative)
        status = self.test_points(points, seen, pixels)
        if surface is not None:
            hidden = hidden_pixels(surface, self.rays, pixels.sums, *wide).reshape(status.shape)
            status[hidden == 1] = Status.HIDDEN_IN_LEFT
            status[hidden == 2] = Status.HIDDEN_IN_RIGHT
        if edge is not None and settings.representative == "top":
            status[(status == Status.LABELLED) & edge] = Status.EDGE_IN_PIXEL
        labels = self.labels(pixels, status == Status.LABELLED, wide)
        agreement = pixels.correlation
        if settings.method == "both":
            agreement = self.test_agreement(labels, pixels, status, left, right, wide)
        if settings.uses_geometry:
            known = np.where(status == Status.LABELLED, labels.disparity, np.nan)
            alone = np.isfinite(known) & ~supported(known, status != Status.NO_POINTS)
            status[alone] = Status.EDGE_IN_PIXEL
        few = (status == Status.LABELLED) & (pixels.count < settings.min_points)
        status[few] = Status.BELOW_MINIMUM_COUNT
        return self.collected(pixels, labels, agreement, status, wide), self.counted(
            points, pixels, status
        )

    def patches(self, wide: tuple[slice, slice], reach: Reach) -> tuple[Patch, Patch]:
        """Of the left image, the window; of the right one, all that its points can be seen in."""
        x, y, height = (
            grid.reshape(-1)
            for grid in np.meshgrid(
                np.linspace(wide[1].start - 1.0, wide[1].stop, 5),
                np.linspace(wide[0].start - 1.0, wide[0].stop, 5),
                [reach.low, reach.high],
            )
        )
        x_right = self.model.ground_to_epipolar(
            *self.model.epipolar_to_ground(x, y, height), height
        )[2]
        x_right = x_right[np.isfinite(x_right)]
        # A few pixels more, for what is not linear in between.
        cols = slice(int(x_right.min(initial=0.0)) - 8, int(x_right.max(initial=0.0)) + 9)
        window = self.settings.images_window
        return read_patch(self.images[0], *wide, window), read_patch(
            self.images[1], wide[0], cols, window
        )

    def collect(
        self, strips: Sequence[Box], wide: tuple[slice, slice], left: Patch, right: Patch
    ) -> tuple[PixelPoints, LocalProjection, Surface | None] | None:
        """The points of a window by pixel, and the surface of all points around; None if none."""
        if not strips:
            return None
        box = [step(strip[k] for strip in strips) for k, step in enumerate((min, min, max, max))]
        heights = self.heights(box)
        if heights is None:
            return None
        low = [int(np.floor(edge / LATTICE_DEG)) for edge in box[:2]]
        high = [int(np.ceil(edge / LATTICE_DEG)) for edge in box[2:]]
        shape = wide[0].stop - wide[0].start, wide[1].stop - wide[1].start
        low_h, high_h = (round(height / LATTICE_M) for height in heights)
        local = LocalProjection.of(self.model, (*low, low_h), (*high, high_h))
        first = wide[0].start, wide[1].start
        collection = Collection(shape, first, (low[0], low[1]), left, right)
        builder = None
        if self.settings.uses_geometry:
            builder = SurfaceBuilder(self.rays, (low[0], low[1]), (high[0], high[1]))
        for strip in strips:
            for store in self.stores:
                points = store.query(*strip)
                for start in range(0, len(points), BLOCK):
                    where = slice(start, start + BLOCK)
                    lattice = points.lon_q[where], points.lat_q[where], points.h_q[where]
                    collection.add(
                        *lattice, points.classification[where], local.at_points(*lattice)
                    )
                    if builder is not None:
                        builder.add(*lattice)
        surface = None if builder is None else builder.built()
        points = collection.sorted()
        if points.points.size == 0 and not points.outside.any():
            return None
        return points, local, surface

    def test_points(
        self, points: PixelPoints, seen: NDArray[np.bool_], pixels: Pixels
    ) -> NDArray[np.uint8]:
        """Status of each pixel by its point that got furthest."""
        status = np.full(points.shape, Status.NO_POINTS, dtype=np.uint8)
        status[points.outside.reshape(points.shape) > 0] = Status.OUT_OF_FRAME
        status[points.count > 0] = Status.HIDDEN_IN_LEFT
        if self.settings.method == "correlation":
            status[points.any(seen)] = Status.LOW_CORRELATION
        status[pixels.count > 0] = Status.LABELLED
        return status

    def labels(self, pixels: Pixels, valid: NDArray[np.bool_], wide: tuple[slice, slice]) -> Labels:
        """Labels of the valid pixels by the settings' representative."""
        if self.settings.representative == "paper":
            return at_points(pixels, valid, self.rays.px_per_m)
        first = wide[0].start, wide[1].start
        return at_centres(pixels, valid, first, self.rays.px_per_m)

    def test_agreement(
        self,
        labels: Labels,
        pixels: Pixels,
        status: NDArray[np.uint8],
        left: Patch,
        right: Patch,
        wide: tuple[slice, slice],
    ) -> Floats:
        """Correlation of the images over each pixel's surface; sets what has changed in status."""
        warped = warp_to_left(right, *wide, labels.disparity)
        top, side = wide[0].start - left.row, wide[1].start - left.col
        shown = left.pixels[top : top + status.shape[0], side : side + status.shape[1]]
        surface = labels.disparity, labels.slope
        found = surface_correlation(shown, warped, *surface, self.settings.window)
        changed = outvoted(found, *surface, self.settings.correlation_threshold)
        changed |= (status == Status.LABELLED) & (pixels.surface_class == WATER_CLASS)
        status[changed] = Status.CHANGED
        return found

    def collected(
        self,
        pixels: Pixels,
        labels: Labels,
        correlation: Floats,
        status: NDArray[np.uint8],
        wide: tuple[slice, slice],
    ) -> dict[str, NDArray]:
        """The layers of a window, without its margin."""
        margin = self.settings.margin
        inner = slice(margin, -margin), slice(margin, -margin)
        y, x = (np.arange(w.start + margin, w.stop - margin, dtype=np.float64) for w in wide)
        if self.view == "right":
            x = self.model.shape[1] - 1 - x
        sigma, sigma_x, sigma_y = self.alignment_sigma.at(x, y)
        slope = labels.slope[:, *inner]
        variance = labels.variance[inner] + sigma**2
        variance = variance + (slope[0] * sigma_x) ** 2 + (slope[1] * sigma_y) ** 2
        values = {
            "disparity": labels.disparity[inner],
            "height": pixels.highest[inner],
            "correlation": correlation[inner],
            "uncertainty": np.sqrt(variance),
        }
        known = status[inner] == Status.LABELLED
        result = {name: np.where(known, v, np.nan).astype(np.float32) for name, v in values.items()}
        kept = known | (status[inner] == Status.BELOW_MINIMUM_COUNT)
        count = np.where(kept, np.minimum(pixels.count[inner], 65535), 0)
        result["point_count"] = count.astype(np.uint16)
        result["surface_class"] = np.where(known, pixels.surface_class[inner], 0).astype(np.uint8)
        result["status"] = status[inner]
        return result

    def counted(
        self, points: PixelPoints, pixels: Pixels, status: NDArray[np.uint8]
    ) -> NDArray[np.int64]:
        """Points of a window without its margin: all, in both frames, used."""
        inner = (slice(self.settings.margin, -self.settings.margin),) * 2
        framed = points.count[inner].sum()
        outside = points.outside.reshape(points.shape)[inner].sum()
        labelled = np.isin(status[inner], (Status.LABELLED, Status.BELOW_MINIMUM_COUNT))
        used = pixels.count[inner][labelled].sum()
        return np.array([framed + outside, framed, used])

    # -- one block

    def windows(self, rows: slice, cols: slice) -> list[tuple[slice, slice]]:
        """The block cut along its longer side until no window expects too many points."""
        reach = self.reach(rows, cols)
        if reach is None:
            return []
        tall, broad = rows.stop - rows.start, cols.stop - cols.start
        many = self.expected(self.strips(rows, cols, reach)) > self.max_points
        if not many or max(tall, broad) <= 128:
            return [(rows, cols)]
        if tall > broad:
            middle = rows.start + tall // 2
            halves = [(slice(rows.start, middle), cols), (slice(middle, rows.stop), cols)]
        else:
            middle = cols.start + broad // 2
            halves = [(rows, slice(cols.start, middle)), (rows, slice(middle, cols.stop))]
        return [window for half in halves for window in self.windows(*half)]

    def key(self, content: str, rows: slice, cols: slice) -> str:
        """Digest of all that the labels of a block follow from: ``content`` and its points."""
        if self.view == "right":
            cols = mirrored(cols, self.model.shape[1])
        reach = self.reach(rows, cols)
        strips = [] if reach is None else self.strips(rows, cols, reach)
        touched = sorted(
            _identity(store.attrs)
            for store in self.stores
            if any(store.height_range(*strip) is not None for strip in strips)
        )
        return digest({"content": content, "points": touched})

    def block(self, out: BlockStore, key: str, rows: slice, cols: slice) -> None:
        """Label one block and write it, with its pixels by status and counts of points."""
        where = rows, cols
        if self.view == "right":
            cols = mirrored(cols, self.model.shape[1])
        shape = rows.stop - rows.start, cols.stop - cols.start
        fill = layers(self.settings, self.view)
        arrays: dict[str, NDArray] = {}
        points = np.zeros(3, dtype=np.int64)
        for r, c in self.windows(rows, cols):
            found = self.label(r, c)
            if found is None:
                continue
            part = (
                slice(r.start - rows.start, r.stop - rows.start),
                slice(c.start - cols.start, c.stop - cols.start),
            )
            for name, layer in found[0].items():
                if name not in arrays:
                    arrays[name] = np.full(shape, fill[name].fill, dtype=layer.dtype)
                arrays[name][part] = layer
            points += found[1]
        status = arrays.get("status", np.zeros(shape, dtype=np.uint8))
        if self.view == "right":
            left, right = (status == s for s in (Status.HIDDEN_IN_LEFT, Status.HIDDEN_IN_RIGHT))
            status[left], status[right] = Status.HIDDEN_IN_RIGHT, Status.HIDDEN_IN_LEFT
            arrays = {name: array[:, ::-1] for name, array in arrays.items()}
        counts = np.bincount(status.reshape(-1), minlength=len(Status))
        out.write(where, key, arrays, [*counts.tolist(), *points.tolist()])


def _identity(attrs: Mapping[str, Any]) -> str:
    """What stands for the values of a store; something new each time if it does not tell."""
    made_of = attrs.get("provenance") or {"unknown": os.urandom(8).hex()}
    return attrs.get("content") or digest(made_of)


def project_scene(
    left_store: str | Path,
    right_store: str | Path,
    point_stores: Sequence[str | Path],
    out: str | Path,
    *,
    view: str = "left",
    method: str = "correlation",
    window: int = 9,
    correlation_threshold: float = 0.5,
    representative: str = "top",
    edge_margin_px: float = 0.0,
    min_points: int = 1,
    workers: int = 1,
    scheduler: Any = "threads",
    code: str = "",
    scene: str = "",
    max_points: int = MAX_POINTS,
    strip: Strip | None = None,
) -> dict[str, Any] | None:
    """Project the points of a scene and write its disparity grid; returns the summary.

    ``left_store``, ``right_store``: rectified images made by `rectify`; ``point_stores``: made by
    `ingest`, in any order. ``view``: left, or right for the labels of the right image, on its own
    grid of the same shape. ``method`` is one of METHODS: ``correlation`` (the paper's filter),
    ``geometric`` (visibility in both views from the points), ``both`` (geometric, and what the
    images contradict is ``changed``), ``none``. ``scheduler`` is what Dask's compute takes;
    ``workers`` the number of its threads. ``code``: digest of the source, for the provenance.

    Blocks that an earlier call has left, made of the same, are taken over (see
    :mod:`stereotruth.products.resumable_grids`). ``strip``: make its blocks only, for a later call
    without it, and return None.

    The store [y, x] on the epipolar grid of the view: see :func:`layers`; attributes ``epipolar``
    (the model), ``view``, ``summary``, ``points_bounds``, ``provenance``. Summary: ``pixels`` by
    status, ``points`` (in the grid, in both frames, used), ``labelled_share`` of the pixels that
    have points, settings.

    Raises InputError if no point falls into both images.
    """
    settings = Settings(
        method, window, correlation_threshold, representative, edge_margin_px, min_points
    )
    # Absolute, since workers of a Dask cluster live in other folders.
    left_store, right_store, out = (Path(p).absolute() for p in (left_store, right_store, out))
    paths = sorted(Path(path).absolute() for path in point_stores)
    if not paths:
        raise InputError("no point store", file=out, remedy="give the scene's LiDAR files")
    job = _Scene(left_store, right_store, tuple(paths), settings, max_points, view)
    model, stores = job.model, job.stores
    corners = np.array([store.bounds for store in stores])
    bounds = [*corners[:, :2].min(0), *corners[:, 2:4].max(0)]
    heights = float(corners[:, 4].min()), float(corners[:, 5].max())
    points_bounds = [float(value) for value in (*bounds, *heights)]
    images = job.ground_box(slice(0, model.shape[0]), slice(0, model.shape[1]), *heights)
    where = stores[0].path.parent
    if images is None:
        raise InputError(
            "the epipolar model reaches no ground", file=left_store, remedy="run rectify again"
        )
    if apart(tuple(bounds), images):
        refuse_apart(tuple(bounds), images, heights, where)
    inputs = {
        name: digest(dict(require_complete(path).attrs.get("provenance", {})))
        for name, path in (
            ("left", left_store),
            ("right", right_store),
            *((f"points/{store.path.name}", store.path) for store in stores),
        )
    }
    parameters = {"view": view} | asdict(settings)
    attrs = {
        "kind": "disparity",
        "scene": scene,
        "view": view,
        "epipolar": dict(require_complete(left_store).attrs["epipolar"]),
        "points_bounds": points_bounds,
        "points_bounds_order": "lon_min, lat_min, lon_max, lat_max (degrees), "
        "height_min, height_max (m, ellipsoidal)",
        "settings": parameters,
        "provenance": describe(inputs, parameters, code),
    }
    left_attrs = require_complete(left_store).attrs
    content = digest(
        {
            "images": [_identity(require_complete(p).attrs) for p in (left_store, right_store)],
            "epipolar": left_attrs["epipolar"],
            "alignment_sigma": left_attrs.get("alignment_sigma"),
            "parameters": parameters,
            "code": code or source_digest("disparity.project"),
        }
    )
    grid = making(
        out,
        model.shape,
        layers(settings, view),
        chunk=CHUNK,
        shard=SHARD,
        shared=strip is not None,
    )
    with grid as unfinished:
        every = blocks(model.shape, SHARD)
        part = every if strip is None else strip.of(every)
        keys = [job.key(content, *block) for block in part]
        tasks = [
            dask.delayed(job.block, pure=False)(
                unfinished, keys[number], *part[number], dask_key_name=f"block-{number:07d}"
            )
            for number in unfinished.missing(part, keys, workers)
        ]
        with BlockProgress(len(tasks), "disparity"):
            dask.compute(*tasks, scheduler=scheduler, num_workers=workers)
        if strip is not None:
            return None
        counts = np.sum(unfinished.results(every), axis=0).tolist()
        pixels = {status.name.lower(): counts[status] for status in Status}
        in_grid, framed, used = counts[len(Status) :]
        if framed == 0:
            refuse_apart(tuple(bounds), images, heights, where)
        reached = sum(pixels.values()) - pixels["no_points"] - pixels["out_of_frame"]
        summary = {
            "pixels": pixels,
            "points": {"in_grid": in_grid, "in_frame": framed, "used": used},
            "labelled_share": round(pixels["labelled"] / max(reached, 1), 6),
        }
        unfinished.publish(out, every, attrs | {"summary": summary})
    log.info(
        "%s: %d pixels labelled, %.1f %% of those with points in both images (%s)",
        settings.method,
        pixels["labelled"],
        100.0 * summary["labelled_share"],
        ", ".join(f"{name} {n}" for name, n in pixels.items() if n and name != "labelled"),
    )
    if settings.images_window > 1 and summary["labelled_share"] < 0.4:
        log.warning(
            "only %.0f %% of the pixels with points are seen alike in both images: check the "
            "vertical datum of the LiDAR (geoid in scenes.tsv), its CRS and the GCP residuals",
            100.0 * summary["labelled_share"],
        )
    return summary
