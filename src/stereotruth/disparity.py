"""Points to disparity: the stage `project` (paper, section III-C).

Every point is projected into both rectified images; hidden points are removed
(:mod:`stereotruth.correlation`, :mod:`stereotruth.occlusion`); what is left of a pixel of the left
epipolar grid is condensed to one ground point, whose own projections give
d = x_left - x_right (px). A point belongs to the pixel (floor(x_left + 0.5), floor(y_left + 0.5)).

A pixel's representative is condensed from the points that passed, by exact integer sums:

- ``top``: mean longitude, latitude and height of the points on the top surface at the pixel's
  centre (:func:`stereotruth.occlusion.seen_surface`). No bias by the largest of several noisy
  heights, and no mixture where a roof's edge and the ground share a pixel. Points of other surfaces
  count as hidden from the left, with every method. Where an edge passes within ``edge_margin_px``
  of the centre, noise of the alignment decides which surface it meets: no label.
- ``paper``: mean longitude and latitude of all points, height of the highest.

Each pixel has one status, that of its point that got furthest through the tests in the order
frame, left view, right view, correlation, edge, number of points; see :class:`Status`.

The grid is worked on in blocks of one shard, each independent of the others; a block is cut into
windows of a bounded number of points. The result has the same bytes for any number of workers, size
of windows, and order of blocks, stores and points.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import dask
import numpy as np
import zarr
from numba import njit
from numpy.typing import NDArray

from .correlation import correlate, in_frame, read_patch
from .epipolar import EpipolarModel
from .errors import InputError
from .grid_store import Layer, blocks, building, create_grid, require_complete
from .occlusion import (
    EDGE,
    FILL_RADII,
    METHODS,
    Rays,
    box_sum,
    build_surface,
    exact_sums,
    hidden_pixels,
    seen_surface,
)
from .points import LATTICE_DEG, LATTICE_M, Points, PointStore, query_points
from .provenance import describe, digest
from .runlog import BlockProgress

log = logging.getLogger("stereotruth")

Floats = NDArray[np.float64]
Box = tuple[float, float, float, float]

CHUNK = 256
SHARD = 1024
MARGIN = EDGE + 1  # px around a window; one for the uncertainty's 3 x 3 pixels
REPRESENTATIVES = ("top", "paper")
MAX_POINTS = 2_500_000  # expected in a window; some 120 bytes each at the peak
HEIGHT_NOISE_M = 0.05  # what airborne LiDAR has at least; floor of the spread in a pixel
_PER_PX = 1 << 16  # disparity spreads and correlations are summed as integers of 2^-16
_PER_DEG, _PER_M = round(1 / LATTICE_DEG), round(1 / LATTICE_M)


class Status(IntEnum):
    """Why a pixel has a label or none."""

    NO_POINTS = 0
    LABELLED = 1
    HIDDEN_IN_LEFT = 2
    HIDDEN_IN_RIGHT = 3
    LOW_CORRELATION = 4
    CHANGED = 5
    OUT_OF_FRAME = 6
    BELOW_MINIMUM_COUNT = 7
    EDGE_IN_PIXEL = 8


# The tests in their order; a point's stage is the test that it failed. Higher got further.
_ORDER = (
    Status.NO_POINTS,
    Status.OUT_OF_FRAME,
    Status.HIDDEN_IN_LEFT,
    Status.HIDDEN_IN_RIGHT,
    Status.LOW_CORRELATION,
    Status.EDGE_IN_PIXEL,
    Status.BELOW_MINIMUM_COUNT,
)
_STAGE = {status: np.uint8(stage) for stage, status in enumerate(_ORDER)}
_STATUS_OF_STAGE = np.array(_ORDER, dtype=np.uint8)


@dataclass(frozen=True)
class Settings:
    """How points are judged and condensed; see the module and config/README.md."""

    method: str = "correlation"
    window: int = 9
    correlation_threshold: float = 0.5
    representative: str = "top"
    edge_margin_px: float = 0.25
    min_points: int = 1

    def __post_init__(self) -> None:
        for name, allowed in (("method", METHODS), ("representative", REPRESENTATIVES)):
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"{name} is {getattr(self, name)!r}", remedy=f"take one of {', '.join(allowed)}"
                )
        if self.window < 3 or self.window % 2 == 0:
            raise InputError(
                f"correlation window of {self.window} px", remedy="take an odd number from 3 on"
            )

    @property
    def uses_correlation(self) -> bool:
        """Whether windows of the images are compared."""
        return self.method in ("correlation", "both")

    @property
    def uses_seen_surface(self) -> bool:
        """Whether points off the surface that the centre sees count as hidden from the left."""
        return self.uses_geometry or self.representative == "top"

    @property
    def uses_geometry(self) -> bool:
        """Whether rays are tested against the surface of the points."""
        return self.method in ("geometric", "both")


def layers(settings: Settings, alignment_sigma_px: float) -> dict[str, Layer]:
    """The arrays of a disparity store."""
    condensed, meant = (
        (
            "mean longitude, latitude and height",
            "points on the surface that the pixel's centre sees and that were not found hidden",
        )
        if settings.representative == "top"
        else (
            "mean longitude and latitude, greatest height",
            "points that were not found hidden",
        )
    )
    return {
        "disparity": Layer(
            "float32",
            np.nan,
            {
                "units": "px",
                "long_name": "ground-truth disparity x_left - x_right of the left view",
                "nodata": "NaN",
                "representative": f"{settings.representative}: {condensed} of the {meant}",
            },
        ),
        "status": Layer(
            "uint8",
            0,
            {
                "units": "1",
                "long_name": "why a pixel has a label or none",
                "flag_values": [int(status) for status in Status],
                "flag_meanings": " ".join(status.name.lower() for status in Status),
                "hidden_in_left": "no point of the pixel lies on the surface that its centre sees",
                "precedence": "of the point that got furthest through the tests: frame, left "
                "view, right view, correlation, edge, number of points",
            },
        ),
        "height": Layer(
            "float32",
            np.nan,
            {
                "units": "m",
                "long_name": "greatest height above the WGS 84 ellipsoid of the points used",
                "nodata": "NaN",
            },
        ),
        "point_count": Layer(
            "uint16",
            0,
            {
                "units": "1",
                "long_name": f"number of points used: {meant}",
                "comment": "counts above 65535 are stored as 65535",
            },
        ),
        "correlation": Layer(
            "float32",
            np.nan,
            {
                "units": "1",
                "long_name": "mean correlation coefficient of the image windows at the points used",
                "nodata": "NaN",
                "comment": "also NaN where the method compares no windows",
            },
        ),
        "uncertainty": Layer(
            "float32",
            np.nan,
            {
                "units": "px",
                "long_name": "standard uncertainty of the disparity (coarse)",
                "nodata": "NaN",
                "formula": "sqrt(max(s, f)^2 / n + a^2): s standard deviation of the disparities "
                "of the points used about their pixel's mean, pooled over 3 x 3 pixels; f that of "
                f"{HEIGHT_NOISE_M:g} m of height; n point_count; a alignment, "
                f"{alignment_sigma_px:g} px",
            },
        ),
    }


# ------------------------------------------------------------------------------------ condensing


@njit(cache=True, nogil=True, error_model="numpy")
def _furthest(pixel: NDArray[np.int64], stage: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    for k in range(pixel.size):
        out[pixel[k]] = max(out[pixel[k]], stage[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _collect(
    pixel: NDArray[np.int64],
    use: NDArray[np.bool_],
    h_q: NDArray[np.int64],
    fall: NDArray[np.int64],
    correlation: NDArray[np.int64],
    out: NDArray[np.int64],
) -> None:
    """Per pixel: greatest height, sums of ``fall``, of its square, and of ``correlation``."""
    for k in range(pixel.size):
        if use[k]:
            i = pixel[k]
            out[i, 0] = max(out[i, 0], h_q[k])
            out[i, 1] += fall[k]
            out[i, 2] += fall[k] * fall[k]
            out[i, 3] += correlation[k]


def condense(
    model: EpipolarModel,
    points: Points,
    disparity: Floats,
    pixel: NDArray[np.int64],
    use: NDArray[np.bool_],
    correlation: NDArray[np.float32] | None,
    shape: tuple[int, int],
    settings: Settings,
    px_per_m: float,
    alignment_sigma_px: float,
) -> dict[str, NDArray]:
    """Layers of a window from its points in ``use``; arrays of ``shape``, without status.

    ``disparity`` (px), ``pixel`` (row-major index into ``shape``) and ``correlation`` are those of
    the points. Pixels of fewer points than ``settings.min_points`` hold their count only. The
    uncertainty of the outermost ring of pixels lacks neighbours.
    """
    size = shape[0] * shape[1]
    sums = exact_sums(points, pixel, use, size)
    # Disparities relative to the pixel's height, as integers: exact sums in any order.
    fall = np.zeros(len(points), dtype=np.int64)
    reference = np.full(size, np.nan)
    n = sums[:, 0]
    found = np.flatnonzero(n)
    lon, lat = sums[found, 1] / n[found] / _PER_DEG, sums[found, 2] / n[found] / _PER_DEG
    more = np.zeros((size, 4), dtype=np.int64)
    more[:, 0] = np.iinfo(np.int64).min
    quantised = np.zeros(len(points), dtype=np.int64)
    if correlation is not None:
        quantised[use] = np.rint(correlation[use].astype(np.float64) * _PER_PX)
    mean_height = sums[found, 3] / n[found] / _PER_M
    xy = model.ground_to_epipolar(lon, lat, mean_height)
    reference[found] = xy[0] - xy[2]
    fall[use] = np.rint((disparity[use] - reference[pixel[use]]) * _PER_PX)
    _collect(pixel, use, points.h_q, fall, quantised, more)
    highest = more[found, 0] / _PER_M
    if settings.representative == "paper":
        xy = model.ground_to_epipolar(lon, lat, highest)

    squares = np.zeros(size)
    fallen = more[found, 1] / n[found]
    squares[found] = (more[found, 2] - fallen * fallen * n[found]) / _PER_PX**2
    freedom = np.zeros(size)
    freedom[found] = n[found] - 1
    squares, freedom = box_sum(squares.reshape(shape)), box_sum(freedom.reshape(shape))
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.where(freedom > 0, squares / freedom, 0.0).reshape(-1)[found]
    variance = np.maximum(variance, (HEIGHT_NOISE_M * px_per_m) ** 2)

    kept = n[found] >= settings.min_points
    out = {
        "disparity": (xy[0] - xy[2]),
        "height": highest,
        "uncertainty": np.sqrt(variance / n[found] + alignment_sigma_px**2),
    }
    if correlation is not None:
        out["correlation"] = more[found, 3] / n[found] / _PER_PX
    result = {}
    for name in ("disparity", "height", "uncertainty", "correlation"):
        layer = np.full(size, np.nan, dtype=np.float32)
        if name in out:
            layer[found[kept]] = out[name][kept]
        result[name] = layer.reshape(shape)
    result["point_count"] = np.minimum(n, 65535).astype(np.uint16).reshape(shape)
    return result


# --------------------------------------------------------------------------------------- windows


@dataclass(frozen=True, eq=False)
class _Scene:
    """What every block needs: plain values, so that it can go to another process."""

    left_store: Path
    right_store: Path
    point_stores: tuple[Path, ...]
    settings: Settings
    alignment_sigma_px: float
    max_points: int

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    @cached_property
    def images(self) -> tuple[zarr.Array, zarr.Array]:
        return tuple(require_complete(p)["image"] for p in (self.left_store, self.right_store))

    @cached_property
    def model(self) -> EpipolarModel:
        return EpipolarModel.from_dict(require_complete(self.left_store).attrs["epipolar"])

    @cached_property
    def stores(self) -> tuple[PointStore, ...]:
        return tuple(PointStore(path) for path in self.point_stores)

    @cached_property
    def rays(self) -> Rays:
        return Rays.of(self.model)

    # -- where the points of a window are

    def ground_box(self, rows: slice, cols: slice, low: float, high: float) -> Box | None:
        """lon, lat box (degrees) of what a window of the left grid can show at these heights."""
        x = np.linspace(cols.start - MARGIN - 1.0, cols.stop + MARGIN, 5)
        y = np.linspace(rows.start - MARGIN - 1.0, rows.stop + MARGIN, 5)
        edge_x = np.concatenate([x, x, np.full(5, x[0]), np.full(5, x[-1])])
        edge_y = np.concatenate([np.full(5, y[0]), np.full(5, y[-1]), y, y])
        ground = np.hstack(
            [np.stack(self.model.epipolar_to_ground(edge_x, edge_y, h)) for h in (low, high)]
        )
        ground = ground[:, np.isfinite(ground).all(axis=0)]
        if ground.size == 0:
            return None
        (west, south), (east, north) = ground.min(axis=1), ground.max(axis=1)
        # Two pixels more, for the curvature of the edges.
        spare = 4.0 * np.array(self.rays.cell) * LATTICE_DEG
        return west - spare[0], south - spare[1], east + spare[0], north + spare[1]

    def heights(self, box: Box) -> tuple[float, float] | None:
        """Lowest and highest point (m) of the stores' cells that a box touches."""
        found = [r for r in (store.height_range(*box) for store in self.stores) if r is not None]
        return (min(r[0] for r in found), max(r[1] for r in found)) if found else None

    def boxes(self, rows: slice, cols: slice) -> tuple[Box, Box] | None:
        """Boxes of the points of a window: those that it can show; those that can hide them.

        None if there are no points.
        """
        low = min(store.bounds[4] for store in self.stores)
        top = high = max(store.bounds[5] for store in self.stores)
        box = None
        for _ in range(3):  # heights narrow the box, the box narrows the heights
            box = self.ground_box(rows, cols, low, high)
            found = None if box is None else self.heights(box)
            if found is None:
                return None
            low, high = found
        reach = self.rays.reach(cols, rows)
        spare = (sum(FILL_RADII) + 2.0) * np.array(self.rays.cell) * LATTICE_DEG
        around = box
        for _ in range(3):
            rise = top - low
            around = (
                box[0] + reach[0, 0] * rise - spare[0],
                box[1] + reach[1, 0] * rise - spare[1],
                box[2] + reach[0, 1] * rise + spare[0],
                box[3] + reach[1, 1] * rise + spare[1],
            )
            top = self.heights(around)[1]
        return box, around

    def expected(self, box: Box) -> float:
        """About how many points lie in a box, if the stores are evenly filled."""
        total = 0.0
        for store in self.stores:
            west, south, east, north = store.bounds[:4]
            share = 1.0
            for a, b, low, high in ((box[0], box[2], west, east), (box[1], box[3], south, north)):
                share *= max(min(b, high) - max(a, low), 0.0) / max(high - low, 1e-12)
            total += store.count * share
        return total

    # -- one window

    def label(self, rows: slice, cols: slice) -> tuple[dict[str, NDArray], NDArray] | None:
        """All layers of a window and its point counts; None if it has no points.

        Counts: points in the window, in both frames, used.
        """
        boxes = self.boxes(rows, cols)
        if boxes is None:
            return None
        settings = self.settings
        points = query_points(self.stores, *boxes[settings.uses_geometry])
        if len(points) == 0:
            return None
        surface = build_surface(points, self.rays) if settings.uses_geometry else None
        wide = (
            slice(rows.start - MARGIN, rows.stop + MARGIN),
            slice(cols.start - MARGIN, cols.stop + MARGIN),
        )
        shape = wide[0].stop - wide[0].start, wide[1].stop - wide[1].start
        xy = self.model.ground_to_epipolar(points.lon, points.lat, points.height)
        with np.errstate(invalid="ignore"):
            inside = (
                (xy[0] >= wide[1].start - 0.5)
                & (xy[0] < wide[1].stop - 0.5)
                & (xy[1] >= wide[0].start - 0.5)
                & (xy[1] < wide[0].stop - 0.5)
                & np.isfinite(xy[2])
            )
        if not inside.any():
            return None
        xy = np.ascontiguousarray(xy[:, inside])
        points = Points(*(getattr(points, f.name)[inside] for f in fields(Points)))
        pixel = (np.floor(xy[1] + 0.5).astype(np.int64) - wide[0].start) * shape[1]
        pixel += np.floor(xy[0] + 0.5).astype(np.int64) - wide[1].start
        stage, use, correlation = self.judge(points, xy, pixel, wide, surface)
        result = condense(
            self.model,
            points,
            xy[0] - xy[2],
            pixel,
            use,
            correlation,
            shape,
            settings,
            self.rays.px_per_m,
            self.alignment_sigma_px,
        )
        furthest = np.zeros(shape[0] * shape[1], dtype=np.uint8)
        _furthest(pixel, stage, furthest)
        status = _STATUS_OF_STAGE[furthest].reshape(shape)
        status[np.isfinite(result["disparity"])] = Status.LABELLED
        result["status"] = status
        own = np.zeros(shape, dtype=np.bool_)
        inner = slice(MARGIN, -MARGIN)
        own[inner, inner] = True
        own = own.reshape(-1)[pixel]
        counts = np.array(
            [own.sum(), (own & (stage > _STAGE[Status.OUT_OF_FRAME])).sum(), (own & use).sum()]
        )
        return {name: layer[inner, inner] for name, layer in result.items()}, counts

    def judge(
        self,
        points: Points,
        xy: Floats,
        pixel: NDArray[np.int64],
        wide: tuple[slice, slice],
        surface: Any,
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32] | None]:
        """Stage of every point (see _ORDER), which may be used, and their correlation."""
        settings = self.settings
        window = settings.window if settings.uses_correlation else 1
        low, high = int(np.floor(xy[2].min())), int(np.floor(xy[2].max())) + 2
        left = read_patch(self.images[0], *wide, window)
        right = read_patch(self.images[1], wide[0], slice(low, high), window)
        use = in_frame(left, right, xy)
        stage = np.where(use, _STAGE[Status.BELOW_MINIMUM_COUNT], _STAGE[Status.OUT_OF_FRAME])
        size = (wide[0].stop - wide[0].start) * (wide[1].stop - wide[1].start)
        if settings.uses_seen_surface:
            framed = use
            use, edge = seen_surface(xy, pixel, framed, *wide, settings.edge_margin_px)
            stage[framed & ~use] = _STAGE[Status.HIDDEN_IN_LEFT]
        if settings.uses_geometry:
            sums = exact_sums(points, pixel, use, size)
            hidden = hidden_pixels(surface, self.rays, sums, *wide)[pixel]
            stage[use & (hidden == 1)] = _STAGE[Status.HIDDEN_IN_LEFT]
            stage[use & (hidden == 2)] = _STAGE[Status.HIDDEN_IN_RIGHT]
            use &= hidden == 0
        correlation = None
        if settings.uses_correlation:
            correlation = np.full(len(points), np.nan, dtype=np.float32)
            correlation[use] = correlate(left, right, xy[:, use], settings.window)
            fail = use & ~(correlation >= settings.correlation_threshold)
            stage[fail] = _STAGE[Status.LOW_CORRELATION]
            use &= ~fail
        if settings.representative == "top":
            stage[use & edge] = _STAGE[Status.EDGE_IN_PIXEL]
            use &= ~edge
        return stage, use, correlation

    # -- one block

    def windows(self, rows: slice, cols: slice) -> list[tuple[slice, slice]]:
        """The block cut along its longer side until no window expects too many points."""
        boxes = self.boxes(rows, cols)
        if boxes is None:
            return []
        tall, broad = rows.stop - rows.start, cols.stop - cols.start
        many = self.expected(boxes[self.settings.uses_geometry]) > self.max_points
        if not many or max(tall, broad) <= 128:
            return [(rows, cols)]
        if tall > broad:
            middle = rows.start + tall // 2
            halves = [(slice(rows.start, middle), cols), (slice(middle, rows.stop), cols)]
        else:
            middle = cols.start + broad // 2
            halves = [(rows, slice(cols.start, middle)), (rows, slice(middle, cols.stop))]
        return [window for half in halves for window in self.windows(*half)]

    def block(self, out: Path, rows: slice, cols: slice) -> NDArray[np.int64]:
        """Label one block and write it; returns pixels by status, and the counts of points."""
        group = zarr.open_group(out, mode="r+")
        shape = rows.stop - rows.start, cols.stop - cols.start
        arrays: dict[str, NDArray] = {}
        points = np.zeros(3, dtype=np.int64)
        for r, c in self.windows(rows, cols):
            found = self.label(r, c)
            if found is None:
                continue
            where = (
                slice(r.start - rows.start, r.stop - rows.start),
                slice(c.start - cols.start, c.stop - cols.start),
            )
            for name, layer in found[0].items():
                if name not in arrays:
                    arrays[name] = np.full(shape, group[name].fill_value, dtype=layer.dtype)
                arrays[name][where] = layer
            points += found[1]
        for name, array in arrays.items():
            group[name][rows, cols] = array
        status = arrays.get("status", np.zeros(shape, dtype=np.uint8))
        return np.concatenate([np.bincount(status.reshape(-1), minlength=len(Status)), points])


# ----------------------------------------------------------------------------------------- stage


def _apart(a: Box, b: Box) -> bool:
    return a[0] > b[2] or b[0] > a[2] or a[1] > b[3] or b[1] > a[3]


def _in_words(box: Box) -> str:
    return f"longitude {box[0]:.5f} to {box[2]:.5f}, latitude {box[1]:.5f} to {box[3]:.5f}"


FAR = 0.5  # degrees; no survey lies that far from the images that it was ordered for


def _refuse_apart(lidar: Box, images: Box, heights: tuple[float, float], file: Path) -> None:
    """InputError that tells points elsewhere from points in a wrong coordinate system."""
    facts = (
        f"the LiDAR covers {_in_words(lidar)} (heights {heights[0]:.1f} to {heights[1]:.1f} m), "
        f"the images {_in_words(images)}"
    )
    gaps = [max(lidar[k] - images[k + 2], images[k] - lidar[k + 2]) for k in (0, 1)]
    if not _apart((lidar[1], lidar[0], lidar[3], lidar[2]), images):
        raise InputError(
            f"wrong coordinate system: longitude and latitude are swapped; {facts}",
            file=file,
            remedy="set lidar_crs in scenes.tsv to the system that the files are in",
        )
    if max(gaps) > FAR:
        raise InputError(
            f"wrong coordinate system: the points lie {max(gaps):.1f} degrees away from the "
            f"images; {facts}",
            file=file,
            remedy="check lidar_crs (zone, hemisphere) in scenes.tsv and the files' own CRS, "
            "and that the scene's row names the right LiDAR",
        )
    raise InputError(
        f"no overlap between LiDAR and images; {facts}",
        file=file,
        remedy="give the LiDAR files of this scene (column lidar of scenes.tsv); if they are, "
        "check lidar_crs and the RPCs",
    )


def project_scene(
    left_store: str | Path,
    right_store: str | Path,
    point_stores: Sequence[str | Path],
    out: str | Path,
    *,
    method: str = "correlation",
    window: int = 9,
    correlation_threshold: float = 0.5,
    representative: str = "top",
    edge_margin_px: float = 0.25,
    min_points: int = 1,
    workers: int = 1,
    scheduler: Any = "threads",
    code: str = "",
    scene: str = "",
    alignment_sigma_px: float = 0.0,
    max_points: int = MAX_POINTS,
) -> dict[str, Any]:
    """Project the points of a scene and write its disparity grid; returns the summary.

    ``left_store``, ``right_store``: rectified images made by `rectify`; ``point_stores``: made by
    `ingest`, in any order. ``method`` is one of METHODS: ``correlation`` (the paper's filter),
    ``geometric`` (visibility in both views from the points), ``both`` (geometric, then the
    filter on what is left), ``none``. ``scheduler`` is what Dask's compute takes;
    ``workers`` the number of its threads. ``code``: digest of the source, for the provenance.
    ``alignment_sigma_px``: standard uncertainty of the disparity from the alignment, if known.

    The store [y, x] on the left epipolar grid: see :func:`layers`; attributes ``epipolar`` (the
    model), ``summary``, ``points_bounds``, ``provenance``. Summary: ``pixels`` by status,
    ``points`` (in the grid, in both frames, used), ``labelled_share`` of the pixels that have
    points, settings.

    Raises InputError if no point falls into both images.
    """
    settings = Settings(
        method, window, correlation_threshold, representative, edge_margin_px, min_points
    )
    paths = sorted(Path(path) for path in point_stores)
    if not paths:
        raise InputError("no point store", file=out, remedy="give the scene's LiDAR files")
    job = _Scene(
        Path(left_store), Path(right_store), tuple(paths), settings, alignment_sigma_px, max_points
    )
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
    if _apart(tuple(bounds), images):
        _refuse_apart(tuple(bounds), images, heights, where)
    inputs = {
        name: digest(dict(require_complete(path).attrs.get("provenance", {})))
        for name, path in (
            ("left", left_store),
            ("right", right_store),
            *((f"points/{store.path.name}", store.path) for store in stores),
        )
    }
    parameters = asdict(settings) | {"alignment_sigma_px": alignment_sigma_px}
    attrs = {
        "kind": "disparity",
        "scene": scene,
        "epipolar": model.to_dict(),
        "points_bounds": points_bounds,
        "points_bounds_order": "lon_min, lat_min, lon_max, lat_max (degrees), "
        "height_min, height_max (m, ellipsoidal)",
        "settings": parameters,
        "provenance": describe(inputs, parameters, code),
    }
    with building(out) as unfinished:
        create_grid(
            unfinished,
            model.shape,
            layers(settings, alignment_sigma_px),
            chunk=CHUNK,
            shard=SHARD,
            attrs=attrs,
        )
        tasks = [
            dask.delayed(job.block, pure=False)(
                unfinished, rows, cols, dask_key_name=f"block-{number:07d}"
            )
            for number, (rows, cols) in enumerate(blocks(model.shape, SHARD))
        ]
        with BlockProgress(len(tasks), "disparity"):
            counts = np.sum(
                dask.compute(*tasks, scheduler=scheduler, num_workers=workers), axis=0
            ).tolist()
        pixels = {status.name.lower(): counts[status] for status in Status}
        in_grid, framed, used = counts[len(Status) :]
        if framed == 0:
            _refuse_apart(tuple(bounds), images, heights, where)
        reached = sum(pixels.values()) - pixels["no_points"] - pixels["out_of_frame"]
        summary = {
            "pixels": pixels,
            "points": {"in_grid": in_grid, "in_frame": framed, "used": used},
            "labelled_share": round(pixels["labelled"] / max(reached, 1), 6),
        }
        zarr.open_group(unfinished, mode="r+").attrs["summary"] = summary
    log.info(
        "%s: %d pixels labelled, %.1f %% of those with points in both images (%s)",
        settings.method,
        pixels["labelled"],
        100.0 * summary["labelled_share"],
        ", ".join(f"{name} {n}" for name, n in pixels.items() if n and name != "labelled"),
    )
    if settings.uses_correlation and summary["labelled_share"] < 0.4:
        log.warning(
            "only %.0f %% of the pixels with points pass the correlation filter: check the "
            "vertical datum of the LiDAR (geoid in scenes.tsv), its CRS and the GCP residuals",
            100.0 * summary["labelled_share"],
        )
    return summary
