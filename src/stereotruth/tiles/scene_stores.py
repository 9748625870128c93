"""What export reads of a scene: stores, labels as tiles have them, and the windows of its tiles.

A disparity store holds all labels. Tiles have those of rough surfaces only if they are sure enough:
a pixel whose label is left out has no disparity and the status ``too_uncertain``, which occurs in
tiles alone.

The phase of each scene's tile grid (origin of its first window, in steps of about an eighth of a
tile) is that which gives most labelled pairs, then most pairs, then most labelled pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job import progress
from ..core.numerics.windows import window_sums
from ..core.products.grids import require_complete
from ..core.products.provenance import digest, file_sha256
from ..core.status import Status
from ..epipolar.model import COLOURS, EpipolarModel
from .label_doubts import ALIGNMENT, LIDAR, STRIPS, Doubt
from .manifest import tile_flags
from .orientation import sensor_record

MAX_RIGHT_NODATA = 0.01  # share of a right crop; ten columns of a slanted image border
OVERVIEW_PX = 1000  # longer side of the pictures in the coverage figure
REASONS = (
    "left image incomplete",
    "right crop outside the right image",
    "right image incomplete",
    "labels incomplete",
)


@dataclass(frozen=True, eq=False)
class SureLabels:
    """The array ``name`` of a disparity store, as the tiles have it; sliced as a Zarr array is.

    Of the labels of rough surfaces, those with an uncertainty above ``limit`` px are left out.
    """

    store: zarr.Group
    name: str
    limit: float

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, cols)."""
        return self.store[self.name].shape

    def __getitem__(self, key: Any) -> NDArray[Any]:
        values = np.array(self.store[self.name][key])
        doubtful = self.store["status"][key] == Status.LABELLED_CROWN
        if doubtful.any():
            doubtful &= ~(self.store["uncertainty"][key] <= self.limit)
            values[doubtful] = Status.TOO_UNCERTAIN if self.name == "status" else np.nan
        return values


Labels = zarr.Array | SureLabels


def tile_labels(store: zarr.Group, flags: Mapping[int, str], limit: float) -> dict[str, Labels]:
    """``disparity`` and ``status`` of a store as its tiles have them; ``flags``: names of its
    status values."""
    names = "disparity", "status"
    if Status.LABELLED_CROWN.label not in flags.values():
        return {name: store[name] for name in names}
    return {name: SureLabels(store, name, limit) for name in names}


class SceneFiles(NamedTuple):
    """What export reads of one scene: its id and stores, and what is known of it otherwise.

    ``alignment``: its file, whose digest is for the record; ``notes``: what it says
    (:class:`stereotruth.align.alignment.Alignment`).
    ``disparity_of_right``: the store of the right view's labels, if they are wanted. ``acquired``:
    days (ISO) of the left and right image by the images sheet, empty where their deliveries tell.
    """

    scene: str
    disparity: Path
    left: Path
    right: Path
    alignment: Path | None = None
    disparity_of_right: Path | None = None
    acquired: tuple[str, str] = ("", "")
    notes: Any = None


@dataclass(frozen=True, eq=False)
class SceneStores:
    """Opened stores of a scene, its epipolar model, and the meaning of the status values.

    ``gcp_rms``: the larger of both views' residuals of the GCPs, px of the images (None without
    GCPs); ``doubts``: warnings of the alignment, a refinement that was refused among them;
    ``remark``: why labels are less sure than the scatter of their tie points, or empty.
    ``disparity``, ``status``, and these of the right view (``of_right``), as the tiles have them.
    ``acquired``: days (ISO) of the left and right image, empty where they are not known. ``light``:
    whether the images share it, and what decided that (:func:`..sensor.site_pairs.pair_light`).
    """

    scene: str
    left: zarr.Array
    right: zarr.Array
    colours: tuple[tuple[zarr.Array, ...], tuple[zarr.Array, ...]] | None  # of left, right
    disparity: Labels
    status: Labels
    height: zarr.Array
    of_right: Mapping[str, Labels] | None
    surface_class: zarr.Array | None
    uncertainty: zarr.Array | None
    lidar_date: zarr.Array | None
    acquired: tuple[str, str]
    gcp_rms: float | None
    model: EpipolarModel
    sensors: Mapping[str, Mapping[str, Any]]
    flags: Mapping[int, str]
    inputs: Mapping[str, str]
    points_per_px: float | None
    points_per_m2: float | None
    lidar: Mapping[str, Any] | None
    light: Mapping[str, Any] | None
    doubts: tuple[str, ...]
    remark: str

    @property
    def told(self) -> list[Doubt]:
        """What alignment and LiDAR say of what the labels are worth."""
        lidar = self.lidar or {}
        found = [Doubt(ALIGNMENT, text) for text in self.doubts]
        found += [Doubt(ALIGNMENT, self.remark, True)] * bool(self.remark)
        found += [Doubt(LIDAR, text) for text in lidar.get("doubts", ())]
        if strips := lidar.get("strips"):
            found += [Doubt(STRIPS, strips["sentence"], True)] * bool(strips["sentence"])
        return found


def open_stores(item: SceneFiles, max_uncertainty_px: float = math.inf) -> SceneStores:
    """Open a scene's stores; InputError if their grids do not fit together.

    ``max_uncertainty_px``: of the labels of rough surfaces that the tiles have.
    """
    disparity = require_complete(item.disparity)
    left, right = require_complete(item.left), require_complete(item.right)
    model = EpipolarModel.from_dict(disparity.attrs["epipolar"])
    for path, group in ((item.disparity, disparity), (item.left, left), (item.right, right)):
        name = "disparity" if group is disparity else "image"
        if group[name].shape != tuple(model.shape):
            raise InputError(
                f"grid of {group[name].shape} px, epipolar model of {tuple(model.shape)} "
                f"(scene {item.scene})",
                file=path,
                remedy="run rectify and project of this scene again",
            )
    status = disparity["status"]
    meanings = status.attrs["flag_meanings"]
    names = meanings.split() if isinstance(meanings, str) else list(meanings)
    flags = dict(zip((int(v) for v in status.attrs["flag_values"]), names))
    sure = tile_labels(disparity, flags, max_uncertainty_px)
    inputs = {
        f"{item.scene}/{name}": digest(dict(group.attrs.get("provenance", {})))
        for name, group in (("left", left), ("right", right), ("disparity", disparity))
    }
    of_right = None
    if item.disparity_of_right is not None:
        store = require_complete(item.disparity_of_right)
        of_right = tile_labels(store, flags, max_uncertainty_px)
        of_store = digest(dict(store.attrs.get("provenance", {})))
        inputs[f"{item.scene}/disparity_of_right"] = of_store
    if item.alignment is not None:
        inputs[f"{item.scene}/alignment"] = file_sha256(item.alignment)
    notes = item.notes
    residuals = () if notes is None else (fit.rms("after") for fit in notes.fits)
    return SceneStores(
        scene=item.scene,
        left=left["image"],
        right=right["image"],
        colours=tuple(tuple(view[name] for name in COLOURS) for view in (left, right))
        if all(name in view for view in (left, right) for name in COLOURS)
        else None,
        disparity=sure["disparity"],
        status=sure["status"],
        height=disparity["height"],
        of_right=of_right,
        surface_class=disparity.get("surface_class"),
        uncertainty=disparity.get("uncertainty"),
        lidar_date=disparity.get("lidar_date"),
        acquired=tuple(
            day or view.attrs.get("acquired") or ""
            for day, view in zip(item.acquired, (left, right))
        ),
        gcp_rms=max(filter(math.isfinite, residuals), default=None),
        model=model,
        sensors={"left": sensor_record(model.left), "right": sensor_record(model.right)},
        flags=tile_flags(flags),
        inputs=inputs,
        points_per_px=disparity.attrs.get("points_per_px"),
        points_per_m2=disparity.attrs.get("points_per_m2"),
        lidar=disparity.attrs.get("lidar"),
        light=disparity.attrs.get("light"),
        doubts=() if notes is None else tuple(notes.warnings),
        remark="" if notes is None else notes.refinement.get("remark", ""),
    )


# ------------------------------------------------------------------ windows


@dataclass(frozen=True, eq=False)
class CellSums:
    """Sums over square cells of ``step`` px; windows start and end at cells.

    ``labelled``, ``left_nodata`` int64[R, C]; ``disparity`` float64[R, C] sums in px;
    ``right_nodata`` int64[R + 1, W + 1] summed from the upper left, by cells along rows and by
    pixels along columns. ``picture`` and ``mask``: every ``scale``-th pixel of the left image and
    of the labels.
    """

    step: int
    labelled: NDArray[np.int64]
    left_nodata: NDArray[np.int64]
    disparity: NDArray[np.float64]
    right_nodata: NDArray[np.int64]
    scale: int
    picture: NDArray[np.uint16]
    mask: NDArray[np.bool_]

    @property
    def mean_disparity(self) -> float:
        """Over all labels of the scene, px; 0 without any."""
        return float(self.disparity.sum() / max(self.labelled.sum(), 1))


@dataclass(frozen=True)
class Window:
    """Where a pair comes from: upper-left pixel in the left grid, offset of the right crop."""

    row0: int
    col0: int
    offset: int
    labelled: bool

    def of_left(self, size: int) -> tuple[slice, slice]:
        """Rows and columns of the left grid, of a window of ``size`` px."""
        return slice(self.row0, self.row0 + size), slice(self.col0, self.col0 + size)


def cell_step(size: int, stride: int) -> int:
    """Side of the cells on which windows start: divides size and stride, near an eighth of size."""
    common = math.gcd(size, stride)
    step = max(d for d in range(1, max(size // 8, 1) + 1) if common % d == 0)
    if step * 128 < size:
        remedy = round(stride * 8 / size) or 1
        raise InputError(
            f"tiles of {size} px at a stride of {stride} px share no common step",
            remedy=f"take a tiles.stride that is a multiple of an eighth of tiles.size, such as "
            f"{remedy * size // 8}",
        )
    return step


def scan_scene(source: SceneStores, step: int, workers: int) -> CellSums:
    """One pass over a scene's grids in blocks of about 1024 px; threads share the blocks."""
    rows, cols = source.left.shape
    shape = (rows // step, cols // step)
    used = (shape[0] * step, shape[1] * step)
    side = step * max(1, round(1024 / step))
    scale = max(1, math.ceil(max(rows, cols) / OVERVIEW_PX))
    labelled = np.zeros(shape, np.int64)
    left_nodata = np.zeros(shape, np.int64)
    disparity = np.zeros(shape, np.float64)
    right_nodata = np.zeros((shape[0] + 1, cols + 1), np.int64)
    small = (-(-rows // scale), -(-cols // scale))
    picture, mask = np.zeros(small, np.uint16), np.zeros(small, bool)

    def block(origin: tuple[int, int]) -> None:
        r, c = origin
        bottom, edge = min(r + side, used[0]), min(c + side, cols)
        right = source.right[r:bottom, c:edge] == 0
        strips = right.reshape(-1, step, edge - c).sum(axis=1)
        right_nodata[1 + r // step : 1 + bottom // step, 1 + c : 1 + edge] = strips
        edge = min(c + side, used[1])
        if edge <= c:
            return
        here = np.s_[r:bottom, c:edge]
        cells = np.s_[r // step : bottom // step, c // step : edge // step]
        folded = ((bottom - r) // step, step, (edge - c) // step, step)
        left, values = source.left[here], source.disparity[here]
        known = np.isfinite(values)
        labelled[cells] = known.reshape(folded).sum(axis=(1, 3))
        left_nodata[cells] = (left == 0).reshape(folded).sum(axis=(1, 3))
        values = np.where(known, values, 0.0).astype(np.float64)
        disparity[cells] = values.reshape(folded).sum(axis=(1, 3))
        thin = np.s_[-r % scale :: scale, -c % scale :: scale]
        put = np.s_[-(-r // scale) : -(-bottom // scale), -(-c // scale) : -(-edge // scale)]
        picture[put], mask[put] = left[thin], known[thin]

    origins = [(r, c) for r in range(0, used[0], side) for c in range(0, cols, side)]
    with ThreadPoolExecutor(workers) as pool:
        for _ in progress(pool.map(block, origins), len(origins), f"{source.scene}: blocks read"):
            pass
    right_nodata = right_nodata.cumsum(axis=0).cumsum(axis=1)
    return CellSums(step, labelled, left_nodata, disparity, right_nodata, scale, picture, mask)


def choose_windows(
    cells: CellSums, size: int, stride: int, min_labelled: float, right_offset: str
) -> tuple[list[Window], tuple[int, int], dict[str, int]]:
    """Windows in row-major order, the phase (row, col) in px, and the count of each outcome."""
    n, step = size // cells.step, cells.step
    if min(cells.labelled.shape) < n:
        return [], (0, 0), {"grid smaller than a tile": 1}
    labelled = window_sums(cells.labelled, n)
    mean = cells.mean_disparity
    offset = np.full(labelled.shape, mean)
    if right_offset == "tile":
        sums = window_sums(cells.disparity, n)
        np.divide(sums, labelled, out=offset, where=labelled > 0)
    offset = np.rint(offset).astype(np.int64)
    row = np.arange(labelled.shape[0])[:, None]
    start = np.arange(labelled.shape[1])[None, :] * step - offset
    width = cells.right_nodata.shape[1] - 1
    inside = (start >= 0) & (start + size <= width)
    a = np.clip(start, 0, width - size)
    total = cells.right_nodata
    missing = total[row + n, a + size] - total[row, a + size] - total[row + n, a] + total[row, a]
    refused = [
        window_sums(cells.left_nodata, n) > 0,
        ~inside,
        missing > MAX_RIGHT_NODATA * size * size,
        labelled < max(min_labelled * size * size, 1),
    ]
    reason = np.select(refused, range(4), default=4)
    every = stride // step
    best: tuple[int, ...] | None = None
    jump = max(1, n // 8)
    for pr in range(0, min(every, labelled.shape[0]), jump):
        for pc in range(0, min(every, labelled.shape[1]), jump):
            here = np.s_[pr::every, pc::every]
            good, pairs = reason[here] == 4, reason[here] >= 3
            score = (int(good.sum()), int(pairs.sum()), int(labelled[here][good].sum()), -pr, -pc)
            best = score if best is None or score > best else best
    assert best is not None
    phase = -best[3], -best[4]
    here = np.s_[phase[0] :: every, phase[1] :: every]
    counts = np.bincount(reason[here].ravel(), minlength=5)
    windows = [
        Window(int(r) * step, int(c) * step, int(offset[r, c]), bool(reason[r, c] == 4))
        for r in range(phase[0], labelled.shape[0], every)
        for c in range(phase[1], labelled.shape[1], every)
        if reason[r, c] >= 3
    ]
    outcome = dict(zip((*REASONS, "labelled"), counts.tolist()))
    outcome["best labelled share in %"] = int(
        100 * np.where(reason >= 3, labelled, 0).max() / size**2
    )
    return windows, (phase[0] * step, phase[1] * step), outcome
