"""Benchmark tiles of a city: windows, crops, labels, manifest (section III-D of the paper).

A tile pair is a square of the left epipolar image and the square of the same rows of the right
one, moved along x by a whole number of pixels (``right_offset_px``: the mean disparity, rounded,
so that no image is resampled again). The tile's disparity is that of the scene less the offset.

Rules for a pair, at its window of the scene's grid:

- complete images: no pixel of the left crop is nodata, the right crop lies inside the right grid
  and at most ``MAX_RIGHT_NODATA`` of it is nodata;
- labelled: a share of at least ``min_labelled`` of its pixels has a disparity. Other pairs with
  complete images go under ``unlabelled/``.

Each labelled pair is held against its images as it is written: SIFT matches, image warping, and the
gates of :mod:`gates`, which flag tiles and scenes in the manifest and the summary.

The phase of each scene's tile grid (origin of its first window, in steps of about an eighth of a
tile) is that which gives most labelled pairs, then most pairs, then most labelled pixels.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import math
import os
import shutil
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
import zarr
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from . import figures
from .agreement import warp_rows
from .epipolar import EpipolarModel
from .errors import InputError
from .evaluation.classes import tile_class
from .evaluation.sift import FIGURES, MATCH_COLUMNS, TileMatches, match_rows, match_tile
from .evaluation.statistics import ErrorSum
from .evaluation.warping import CorrelationSum, agreement
from .gates import NO_LIMITS, Limits, flag, missed
from .grid_store import replacing, require_complete
from .ledger import Ledger, link
from .locking import exclusive
from .orientation import orientation, save, sensor_record
from .provenance import describe, digest, file_sha256, source_digest
from .runlog import progress
from .splits import NONE, Place, scaled_counts, split_tiles

log = logging.getLogger("stereotruth")

MAX_RIGHT_NODATA = 0.01  # share of a right crop; ten columns of a slanted image border
OVERVIEW_PX = 1400  # longer side of the pictures in the coverage figure
CONTACT_TILES = 16  # most tiles on the contact sheet
FILES = ("left", "right", "disp", "status", "orientation")
RIGHT_FILES = ("disp_right", "status_right")  # labels of the right view, where a scene has them
NONE_KIND, IMAGES, LABELLED = 0, 1, 2
REASONS = (
    "left image incomplete",
    "right crop outside the right image",
    "right image incomplete",
    "labels incomplete",
)


class Scene(NamedTuple):
    """What export reads of one scene: its id and stores, and where it came from the alignment.

    ``disparity_of_right``: the store of the right view's labels, if they are wanted.
    """

    scene: str
    disparity: Path
    left: Path
    right: Path
    alignment: Path | None = None
    disparity_of_right: Path | None = None


@dataclass(frozen=True, eq=False)
class _Source:
    """Opened stores of a scene, its epipolar model, and the meaning of the status values."""

    scene: str
    left: zarr.Array
    right: zarr.Array
    disparity: zarr.Array
    status: zarr.Array
    height: zarr.Array
    of_right: zarr.Group | None
    surface_class: zarr.Array | None
    gcp_rms: float | None
    model: EpipolarModel
    sensors: Mapping[str, Mapping[str, Any]]
    flags: Mapping[int, str]
    inputs: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class _Cells:
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


# ------------------------------------------------------------------------------ tile windows


def _open(item: Scene) -> _Source:
    disparity = require_complete(item.disparity)
    left, right = require_complete(item.left), require_complete(item.right)
    model = EpipolarModel.from_dict(disparity.attrs["epipolar"])
    for path, group, name in (
        (item.disparity, disparity, "disparity"),
        (item.left, left, "image"),
        (item.right, right, "image"),
    ):
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
    inputs = {
        f"{item.scene}/{name}": digest(dict(group.attrs.get("provenance", {})))
        for name, group in (("left", left), ("right", right), ("disparity", disparity))
    }
    of_right = None
    if item.disparity_of_right is not None:
        of_right = require_complete(item.disparity_of_right)
        found = digest(dict(of_right.attrs.get("provenance", {})))
        inputs[f"{item.scene}/disparity_of_right"] = found
    if item.alignment is not None:
        inputs[f"{item.scene}/alignment"] = file_sha256(item.alignment)
    return _Source(
        scene=item.scene,
        left=left["image"],
        right=right["image"],
        disparity=disparity["disparity"],
        status=status,
        height=disparity["height"],
        of_right=of_right,
        surface_class=disparity.get("surface_class"),
        gcp_rms=None if item.alignment is None else _gcp_rms(item.alignment),
        model=model,
        sensors={"left": sensor_record(model.left), "right": sensor_record(model.right)},
        flags=dict(zip((int(v) for v in status.attrs["flag_values"]), names)),
        inputs=inputs,
    )


def _gcp_rms(alignment: Path) -> float | None:
    """The larger of both views' residuals of the GCPs, px of the images; None without GCPs."""
    record = json.loads(Path(alignment).read_text(encoding="utf-8"))
    found = [record[view]["rms"]["after"] for view in ("left", "right")]
    return max((value for value in found if value is not None), default=None)


def _cell_step(size: int, stride: int) -> int:
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


def _scan(source: _Source, step: int, workers: int) -> _Cells:
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
    return _Cells(step, labelled, left_nodata, disparity, right_nodata, scale, picture, mask)


def _window_sums(cells: NDArray[Any], n: int) -> NDArray[Any]:
    """Sums over n × n cells from every origin."""
    total = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1), cells.dtype)
    total[1:, 1:] = cells.cumsum(axis=0).cumsum(axis=1)
    return total[n:, n:] - total[:-n, n:] - total[n:, :-n] + total[:-n, :-n]


def _choose(
    cells: _Cells, size: int, stride: int, min_labelled: float, right_offset: str
) -> tuple[list[Window], tuple[int, int], dict[str, int]]:
    """Windows in row-major order, the phase (row, col) in px, and the count of each outcome."""
    n, step = size // cells.step, cells.step
    if min(cells.labelled.shape) < n:
        return [], (0, 0), {"grid smaller than a tile": 1}
    labelled = _window_sums(cells.labelled, n)
    mean = cells.mean_disparity
    offset = np.full(labelled.shape, mean)
    if right_offset == "tile":
        sums = _window_sums(cells.disparity, n)
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
        _window_sums(cells.left_nodata, n) > 0,
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


# ------------------------------------------------------------------------------------ checks


@dataclass(frozen=True, eq=False)
class _Checks:
    """What its images say about a labelled tile: class, SIFT matches, sums of image warping."""

    kind: str
    matches: TileMatches
    warping: CorrelationSum

    def figures(self) -> dict[str, float | int | None]:
        """By names of the manifest."""
        return self.matches.figures() | {"warp_correlation": _finite(self.warping.coefficient)}

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, to the last bit."""
        matches = {f.name: getattr(self.matches, f.name).tolist() for f in fields(self.matches)}
        return {"kind": self.kind, "matches": matches, "warping": asdict(self.warping)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> _Checks:
        """The inverse of :meth:`to_dict`."""
        types = {"surface_class": np.uint8}
        matches = {
            name: np.array(column, dtype=types.get(name, np.float64))
            for name, column in values["matches"].items()
        }
        return cls(values["kind"], TileMatches(**matches), CorrelationSum(**values["warping"]))


@dataclass
class _SceneChecks:
    """The same of all labelled tiles of a scene."""

    gcp_rms: float | None = None
    errors: ErrorSum = field(default_factory=ErrorSum)
    parallax: ErrorSum = field(default_factory=ErrorSum)
    warping: CorrelationSum = field(default_factory=CorrelationSum)

    def add(self, checks: _Checks) -> None:
        """Add those of a tile."""
        self.errors.add(checks.matches.row_errors)
        self.parallax.add(checks.matches.agreeing_parallax)
        self.warping.merge(checks.warping)

    def figures(self) -> dict[str, float | int | None]:
        """By names of the manifest, over all matches and all labelled pixels of the tiles."""
        errors, parallax = self.errors.figures(), self.parallax.figures()
        return {
            "gcp_rms_px": self.gcp_rms,
            "sift_matches": errors["count"],
            "sift_mean_error_px": errors["bias"],
            "sift_mean_absolute_error_px": errors["mean_absolute"],
            "sift_median_error_px": errors["median"],
            "y_parallax_median_px": parallax["median"],
            "y_parallax_rms_px": parallax["rms"],
            "warp_correlation": _finite(self.warping.coefficient),
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


CHECK_COLUMNS = (*FIGURES, "warp_correlation")


def _check_cells(checks: _Checks | None, limits: Limits) -> dict[str, Any]:
    """Cells of the manifest; empty for pairs without complete labels."""
    if checks is None:
        return dict.fromkeys(("class", *CHECK_COLUMNS, "quality"), "")
    figures = checks.figures()
    cells = {
        name: "" if (v := figures[name]) is None else v if isinstance(v, int) else f"{v:.4f}"
        for name in CHECK_COLUMNS
    }
    return {"class": checks.kind, **cells, "quality": flag(missed(figures, limits))}


# ---------------------------------------------------------------------------------- one tile


def write_tiff(
    path: Path,
    array: NDArray[Any],
    *,
    nodata: float | None = None,
    half: bool = False,
    description: str = "",
) -> None:
    """A one-band deflate TIFF that libtiff's readers open; ``half`` stores float32 in 16 bits.

    GDAL writes IEEE half precision for 32-bit float with NBITS=16. Values must be rounded to
    half precision before.
    """
    rows, cols = array.shape
    integer = np.issubdtype(array.dtype, np.integer)
    options: dict[str, Any] = {"nbits": 16} if half else {}
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=cols,
        height=rows,
        count=1,
        dtype=array.dtype,
        nodata=nodata,
        compress="deflate",
        predictor=2 if integer else 1,  # readers without libtiff know no float predictor
        blockysize=min(rows, 64),
        **options,
    ) as dataset:
        dataset.write(array, 1)
        if description:
            dataset.update_tags(TIFFTAG_IMAGEDESCRIPTION=description)


def round_disparity(disparity: NDArray[np.float64], dtype: str) -> NDArray[np.float32]:
    """Disparities as stored, in float32: rounded to nearest for float16."""
    return disparity.astype(dtype).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Cut:
    """How the tiles of a city are cut and written."""

    city: str
    prefix: str
    size: int
    dtype: str
    nodata: float
    building_share: float
    limits: Limits
    code: str
    work: Path  # where the files of finished tiles wait, with the ledger
    provenance: Mapping[str, Any]

    @property
    def ledger(self) -> Ledger:
        """Records of the tiles whose files are there."""
        return Ledger(self.work / "done")


@dataclass(frozen=True, eq=False)
class _Crop:
    """The pixels of a tile, and what they are called."""

    left: NDArray[np.uint16]
    right: NDArray[np.uint16]
    disparity: NDArray[np.float64]  # of the pair, NaN where there is none
    stored: NDArray[np.float32]  # the same as the file has it
    status: NDArray[np.uint8]
    of_right: NDArray[np.float32] | None
    status_of_right: NDArray[np.uint8] | None

    @classmethod
    def of(cls, source: _Source, window: Window, cut: _Cut) -> _Crop:
        rows, start = slice(window.row0, window.row0 + cut.size), window.col0 - window.offset
        here = (rows, slice(window.col0, window.col0 + cut.size))
        there = (rows, slice(start, start + cut.size))
        disparity = source.disparity[here].astype(np.float64) - window.offset
        of_right = status_of_right = None
        if window.labelled and source.of_right is not None:
            values = source.of_right["disparity"][there].astype(np.float64) - window.offset
            of_right = round_disparity(values, cut.dtype)
            status_of_right = source.of_right["status"][there]
        return cls(
            left=source.left[here],
            right=source.right[there],
            disparity=disparity,
            stored=round_disparity(disparity, cut.dtype),
            status=source.status[here],
            of_right=of_right,
            status_of_right=status_of_right,
        )

    def arrays(self) -> list[NDArray[Any]]:
        """All that the tile's files but the orientation follow from."""
        found = (getattr(self, f.name) for f in fields(self))
        return [np.ascontiguousarray(array) for array in found if array is not None]


def _names(source: _Source, window: Window, number: int, prefix: str) -> dict[str, str]:
    """Paths of a tile's files in the city's folder, by kind."""
    group = "" if window.labelled else "unlabelled/"
    names = {
        "left": f"{group}left/{prefix}_left_{number}.tiff",
        "right": f"{group}right/{prefix}_right_{number}.tiff",
        "orientation": f"orientation/{prefix}_{number}.json",
    }
    if window.labelled:
        names["disp"] = f"disp/{prefix}_disparity_{number}.tiff"
        names["status"] = f"status/{prefix}_status_{number}.tiff"
        if source.of_right is not None:
            names["disp_right"] = f"disp_right/{prefix}_disparity_right_{number}.tiff"
            names["status_right"] = f"status_right/{prefix}_status_right_{number}.tiff"
    return names


def _write_images(
    paths: Mapping[str, Path], source: _Source, window: Window, crop: _Crop, cut: _Cut
) -> None:
    """Write a tile's TIFF files."""
    for path in paths.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    write_tiff(paths["left"], crop.left, nodata=0)
    write_tiff(paths["right"], crop.right, nodata=0)
    if not window.labelled:
        return
    meanings = ", ".join(f"{value} {meaning}" for value, meaning in source.flags.items())
    options = {"nodata": cut.nodata, "half": cut.dtype == "float16"}
    known = np.isfinite(crop.disparity)
    _write_labels(paths["disp"], np.where(known, crop.stored, np.nan), **options)
    write_tiff(paths["status"], crop.status, description=meanings)
    if crop.of_right is not None and crop.status_of_right is not None:
        _write_labels(paths["disp_right"], crop.of_right, **options)
        write_tiff(paths["status_right"], crop.status_of_right, description=meanings)


def _finished(
    source: _Source, window: Window, names: Mapping[str, str], crop: _Crop, cut: _Cut
) -> tuple[dict[str, str], _Checks | None]:
    """Write a tile's TIFF files and check it, or take it over; their checksums, and the checks.

    A tile is taken over if its pixels, what its checks need, names, settings and code are the same.
    """
    here = (
        slice(window.row0, window.row0 + cut.size),
        slice(window.col0, window.col0 + cut.size),
    )
    surface_class = np.zeros(crop.left.shape, np.uint8)
    if source.surface_class is not None:
        surface_class = np.asarray(source.surface_class[here])
    kind = ""
    if window.labelled:
        kind = tile_class(surface_class, source.height, here, cut.building_share)
    pixels = hashlib.sha256()
    for array in (*crop.arrays(), surface_class):
        pixels.update(array)
    files = {name: path for name, path in names.items() if name != "orientation"}
    paths = {name: cut.work / path for name, path in files.items()}
    made_of = {
        "pixels": pixels.hexdigest(),
        "files": files,
        "flags": [[int(value), meaning] for value, meaning in source.flags.items()],
        "settings": [cut.dtype, cut.nodata, kind],
        "code": cut.code,
    }
    key, tile = digest(made_of), f"{cut.prefix}_{names['left'].rpartition('_')[2][:-5]}"
    piece = cut.ledger.find(tile, key, paths)
    if piece is None:
        _write_images(paths, source, window, crop, cut)
        checks = None
        if window.labelled:
            checks = _check(crop, surface_class, kind)
        piece = cut.ledger.put(tile, key, paths, None if checks is None else checks.to_dict())
    found = piece.result
    return dict(piece.sha256), None if found is None else _Checks.from_dict(found)


def _write_tile(
    folder: Path, source: _Source, window: Window, number: int, cut: _Cut
) -> tuple[dict[str, Any], NDArray[np.float64], _Checks | None]:
    """Put a tile into ``folder``: manifest row (without split), ring on the ground, checks."""
    name = f"{cut.prefix}_{number}"
    crop = _Crop.of(source, window, cut)
    known, disparity = np.isfinite(crop.disparity), crop.disparity
    if any((v == cut.nodata).any() for v in (crop.stored, crop.of_right) if v is not None):
        raise InputError(
            f"tile {name} has a true disparity of {cut.nodata:g} px, the value for nodata",
            remedy="set tiles.nodata to a value that no disparity takes",
        )
    files = _names(source, window, number, cut.prefix)
    sums, checks = _finished(source, window, files, crop, cut)
    for kind in sums:
        link(cut.work / files[kind], folder / files[kind])
    height = source.height[
        window.row0 : window.row0 + cut.size, window.col0 : window.col0 + cut.size
    ]
    record = orientation(
        source.model,
        source.sensors,
        row0=window.row0,
        col0=window.col0,
        size=cut.size,
        offset=window.offset,
        height=height,
        disparity=np.where(known, crop.stored, np.nan),
    )
    head = {"tile": name, "city": cut.city, "scene": source.scene, "files": files}
    save(folder / files["orientation"], head | record | {"provenance": cut.provenance})
    sums["orientation"] = file_sha256(folder / files["orientation"])

    ring = np.array(record["footprint"]["coordinates"][0][:-1])
    match = np.arange(cut.size) - disparity
    inside = (match >= -0.5) & (match <= cut.size - 0.5)
    values = crop.stored[known].astype(np.float64)
    lon, lat = ring.mean(axis=0)
    row = {
        "tile": name,
        "number": number,
        "city": cut.city,
        "scene": source.scene,
        "row0": window.row0,
        "col0": window.col0,
        "size": cut.size,
        "right_offset_px": window.offset,
        "complete": "yes" if window.labelled else "no",
        "split": NONE,
        "labelled_share": f"{known.mean():.6f}",
        "matched_share": f"{inside.sum() / max(known.sum(), 1):.6f}",
        "disparity_min_px": f"{values.min():.4f}" if values.size else "",
        "disparity_mean_px": f"{values.mean():.4f}" if values.size else "",
        "disparity_max_px": f"{values.max():.4f}" if values.size else "",
        "disparity_rounding_px": (
            f"{np.abs(values - disparity[known]).max():.6f}" if values.size else ""
        ),
        "disparity_nodata": f"{cut.nodata:g}",
        "lon": f"{lon:.7f}",
        "lat": f"{lat:.7f}",
        **_check_cells(checks, cut.limits),
    }
    for value, meaning in source.flags.items():
        row[f"count_{meaning}"] = int((crop.status == value).sum())
    for kind in (*FILES, *(RIGHT_FILES if source.of_right is not None else ())):
        row[kind] = files.get(kind, "")
        row[f"{kind}_sha256"] = sums.get(kind, "")
    return row, ring, checks


def _write_labels(path: Path, disparity: NDArray[np.float32], *, nodata: float, half: bool) -> None:
    """Disparities (px, NaN where there is none) as a TIFF."""
    write_tiff(
        path,
        np.where(np.isfinite(disparity), disparity, np.float32(nodata)),
        nodata=nodata,
        half=half,
        description="disparity in px, x_left - x_right of this pair",
    )


def _check(crop: _Crop, surface_class: NDArray[np.uint8], kind: str) -> _Checks:
    """Hold the labels of a tile, as stored, against its images."""
    left, right = crop.left, crop.right
    disparity = np.where(np.isfinite(crop.disparity), crop.stored.astype(np.float64), np.nan)
    x = np.arange(left.shape[1])[None, :] - disparity
    return _Checks(
        kind=kind,
        matches=match_tile(left, right, disparity, surface_class),
        warping=agreement(left.astype(np.float64), warp_rows(right.astype(np.float64), x)),
    )


def write_manifest(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows of one kind as CSV; the columns are those of the first row."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


# ------------------------------------------------------------------------------------ a city


def _refuse_empty(
    city: str, outcomes: Mapping[str, Mapping[str, int]], size: int, min_labelled: float
) -> None:
    lines = [
        f"scene {scene}: " + ", ".join(f"{count} {what}" for what, count in outcome.items())
        for scene, outcome in outcomes.items()
    ]
    raise InputError(
        f"{city}: not one labelled tile pair of {size} px ({'; '.join(lines)})",
        remedy=f"a smaller tiles.size (now {size}), a smaller tiles.min_labelled (now "
        f"{min_labelled:g}), or LiDAR that covers the overlap of the two images",
    )


def export_city(
    city: str,
    prefix: str,
    scenes: Iterable[Scene | tuple],
    out_dir: str | Path,
    *,
    size: int = 1024,
    stride: int | None = None,
    min_labelled: float = 0.6,
    right_offset: str = "tile",
    disparity_dtype: str = "float16",
    nodata: float = -999.0,
    training: int = 0,
    validation: int = 0,
    testing: int = 0,
    seed: int = 0,
    strict: bool = False,
    quality: Limits = NO_LIMITS,
    building_share: float = 0.02,
    code: str = "",
    workers: int = 1,
    coverage: str | Path | None = None,
    contact_sheet: str | Path | None = None,
    matches: str | Path | None = None,
    work: str | Path | None = None,
) -> dict[str, Any]:
    """Cut a city's scenes into tiles: the whole folder ``tiles/<City>``, or nothing.

    ``scenes``: per scene its id, disparity.zarr, left.zarr, right.zarr and optionally
    alignment.json (for the record) and the store of the right view's labels. ``stride`` defaults to
    ``size``, px. ``training``, ``validation``, ``testing`` are the counts of table 3, which are
    scaled to the tiles there are. ``quality``: the limits beyond which tiles and scenes are
    flagged. ``building_share``: share of building pixels from which on a tile is of that class.
    ``coverage`` and ``contact_sheet`` are PNG files to write, ``matches`` a CSV file of all SIFT
    matches. ``work``: folder in which finished tiles wait for a later call that would make the
    same, by default a hidden one beside ``out_dir``. Returns a summary, see :func:`summary_lines`.

    Raises InputError if there is no labelled pair, if the settings cannot work, or if
    ``strict`` and the splits' counts cannot be met or a limit of ``quality`` is exceeded.
    """
    out, stride = Path(out_dir), stride or size
    half = disparity_dtype == "float16"
    if float(np.dtype(disparity_dtype).type(nodata)) != float(nodata):
        raise InputError(
            f"nodata {nodata:g} cannot be stored in {disparity_dtype}",
            remedy="set tiles.nodata to -999, or tiles.disparity_dtype to float32",
        )
    step = _cell_step(size, stride)
    sources, chosen, phases, outcomes, scans = [], [], {}, {}, {}
    for item in scenes:
        source = _open(Scene(*item))
        cells = _scan(source, step, workers)
        windows, phase, outcome = _choose(cells, size, stride, min_labelled, right_offset)
        sources.append(source)
        chosen += [(source, window) for window in windows]
        phases[source.scene], outcomes[source.scene] = phase, outcome
        scans[source.scene] = (cells.picture, cells.mask, cells.scale)
    if not any(window.labelled for _, window in chosen):
        _refuse_empty(city, outcomes, size, min_labelled)
    chosen.sort(key=lambda pair: not pair[1].labelled)  # stable: unlabelled pairs get last numbers
    parameters = {
        "size": size,
        "stride": stride,
        "min_labelled": min_labelled,
        "right_offset": right_offset,
        "disparity_dtype": disparity_dtype,
        "nodata": nodata,
        "split_counts": {"train": training, "val": validation, "test": testing},
        "seed": seed,
        "quality": asdict(quality),
        "building_share": building_share,
    }
    inputs = {name: value for source in sources for name, value in source.inputs.items()}
    provenance = describe(inputs, parameters, code)

    cut = _Cut(
        city=city,
        prefix=prefix,
        size=size,
        dtype=disparity_dtype,
        nodata=nodata,
        building_share=building_share,
        limits=quality,
        code=code or source_digest("tiles"),
        work=out.with_name(f".{out.name}.work") if work is None else Path(work),
        provenance=provenance,
    )
    scratch = out.with_name(out.name + ".partial")
    with ExitStack() as stack:
        stack.enter_context(exclusive(out))
        shutil.rmtree(scratch, ignore_errors=True)
        stack.callback(shutil.rmtree, scratch, ignore_errors=True)
        # all appear when the tiles do: a job that outlives its run cannot be found halfway
        matches, coverage, contact_sheet = (
            None if path is None else stack.enter_context(replacing(path))
            for path in (matches, coverage, contact_sheet)
        )
        kinds = {"left", "right", "disp", "status", "orientation"}
        if any(source.of_right is not None for source in sources):
            kinds |= set(RIGHT_FILES)
        if not all(window.labelled for _, window in chosen):
            kinds |= {"unlabelled/left", "unlabelled/right"}
        for kind in kinds:
            (scratch / kind).mkdir(parents=True)

        def write(k: int) -> tuple[dict[str, Any], NDArray[np.float64], _Checks | None]:
            return _write_tile(scratch, *chosen[k], k, cut)

        written, scene_checks = [], {s.scene: _SceneChecks(s.gcp_rms) for s in sources}
        matches_file = Path(os.devnull) if matches is None else matches
        with (
            warnings.catch_warnings(),
            matches_file.open("w", newline="", encoding="utf-8") as stream,
            ThreadPoolExecutor(workers) as pool,
        ):
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            writer = csv.DictWriter(stream, MATCH_COLUMNS, lineterminator="\n")
            writer.writeheader()
            numbers = range(len(chosen))
            done = progress(pool.map(write, numbers), len(chosen), f"{city}: tiles")
            for row, ring, checks in done:
                written.append((row, ring))
                if checks is not None:
                    head = {key: row[key] for key in ("city", "scene", "tile", "class")}
                    writer.writerows(match_rows(head, checks.matches))
                    scene_checks[row["scene"]].add(checks)
        rows = [row for row, _ in written]
        splits = _split(written, parameters["split_counts"], seed, strict, city)
        gates = _gates(city, rows, scene_checks, quality, strict)
        summary = _summary(city, rows, splits, phases, outcomes, parameters, half)
        summary["quality"] = gates
        write_manifest(scratch / "manifest.csv", rows)
        record = summary | {
            "manifest_sha256": file_sha256(scratch / "manifest.csv"),
            "provenance": provenance,
        }
        save(scratch / "export.json", record)
        if coverage is not None:
            _draw_coverage(coverage, city, rows, scans)
        if contact_sheet is not None:
            _draw_contact_sheet(contact_sheet, city, rows, scratch, nodata)
        shutil.rmtree(out, ignore_errors=True)
        scratch.rename(out)
        _forget_others(cut, rows)
    return summary


def _forget_others(cut: _Cut, rows: Sequence[Mapping[str, Any]]) -> None:
    """Remove what earlier calls have left for tiles that are no more."""
    cut.ledger.keep_only({row["tile"] for row in rows})
    kept = {
        cut.work / row[kind] for row in rows for kind in (*FILES, *RIGHT_FILES) if row.get(kind)
    }
    for file in cut.work.rglob("*.tiff"):
        if file not in kept:
            file.unlink()


def _split(
    written: Sequence[tuple[dict[str, Any], NDArray[np.float64]]],
    weights: Mapping[str, int],
    seed: int,
    strict: bool,
    city: str,
) -> dict[str, Any]:
    """Set the split of every labelled row; wanted and realised counts."""
    labelled = [(row, ring) for row, ring in written if row["complete"] == "yes"]
    places = [
        Place(row["scene"], row["row0"], row["col0"], row["size"], ring) for row, ring in labelled
    ]
    found = split_tiles(places, weights, seed)
    for (row, _), split in zip(labelled, found):
        row["split"] = split
    wanted = scaled_counts(len(labelled), weights)
    realised = {name: found.count(name) for name in (*wanted, NONE)}
    if any(realised[name] != count for name, count in wanted.items()):
        problem = (
            f"{city}: splits of {_counts(realised)} tiles instead of {_counts(wanted)}, since "
            "tiles that share ground must not be in two splits"
        )
        if strict:
            raise InputError(problem, remedy="a tiles.stride of tiles.size, or strict: false")
        log.warning("%s", problem)
    return {"wanted": wanted, "realised": realised}


def _gates(
    city: str,
    rows: Sequence[Mapping[str, Any]],
    scenes: Mapping[str, _SceneChecks],
    limits: Limits,
    strict: bool,
) -> dict[str, Any]:
    """Figures and missed gates of scenes, flagged tiles; logs each miss, or ends a strict run."""
    found, problems = {}, []
    for scene, checks in scenes.items():
        figures = checks.figures()
        misses = missed(figures, limits)
        found[scene] = figures | {"quality": flag(misses)}
        problems += [f"scene {scene}: {miss}" for miss in misses]
    labelled = [row for row in rows if row["complete"] == "yes"]
    for row in labelled:
        figures = {name: float(row[name]) for name in CHECK_COLUMNS if row[name] != ""}
        problems += [
            f"tile {row['tile']} of scene {row['scene']}: {miss}"
            for miss in missed(figures, limits)
        ]
    if problems and strict:
        more = f"; and {len(problems) - 5} more" if len(problems) > 5 else ""
        raise InputError(
            f"{city}: beyond the limits of quality: {'; '.join(problems[:5])}{more}",
            remedy="better control points, images or LiDAR for what is named, another limit "
            "(null: none) in quality of the configuration, or strict: false to have it flagged",
        )
    for problem in problems:
        log.warning("%s: %s", city, problem)
    return {
        "limits": asdict(limits),
        "scenes": found,
        "flagged_tiles": {r["tile"]: r["quality"] for r in labelled if r["quality"] != "ok"},
    }


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _summary(
    city: str,
    rows: Sequence[Mapping[str, Any]],
    splits: Mapping[str, Any],
    phases: Mapping[str, tuple[int, int]],
    outcomes: Mapping[str, Mapping[str, int]],
    parameters: Mapping[str, Any],
    half: bool,
) -> dict[str, Any]:
    labelled = [row for row in rows if row["complete"] == "yes"]
    pixels = len(labelled) * int(parameters["size"]) ** 2
    status = {
        name.removeprefix("count_"): sum(row[name] for row in labelled) / pixels
        for name in labelled[0]
        if name.startswith("count_")
    }
    largest = max(float(row["disparity_rounding_px"]) for row in labelled)
    return {
        "city": city,
        "labelled_pairs": len(labelled),
        "unlabelled_pairs": len(rows) - len(labelled),
        "size_px": parameters["size"],
        "splits": dict(splits),
        "scenes": {
            scene: {"grid_phase_row_col_px": list(phases[scene]), "windows": dict(outcome)}
            for scene, outcome in outcomes.items()
        },
        "share_of_pixels": {name: round(share, 6) for name, share in status.items()},
        "disparity_px": {
            "min": min(float(row["disparity_min_px"]) for row in labelled),
            "max": max(float(row["disparity_max_px"]) for row in labelled),
        },
        "disparity_rounding": {
            "largest_px": largest,
            "meaning": (
                "16-bit float: at most 1/128 px off below 32 px, 1/64 below 64, 1/32 below 128, "
                "1/16 from 128 px on"
                if half
                else "32-bit float: none that matters"
            ),
        },
    }


def summary_lines(summary: Mapping[str, Any], out_dir: str | Path) -> list[str]:
    """What was made and where to look, for the end of a run."""
    labelled = summary["share_of_pixels"].get("labelled", 0.0)
    low, high = summary["disparity_px"]["min"], summary["disparity_px"]["max"]
    lines = [
        f"{summary['city']}: {summary['labelled_pairs']} labelled pairs of "
        f"{summary['size_px']} × {summary['size_px']} px "
        f"({_counts(summary['splits']['realised'])}), "
        f"{summary['unlabelled_pairs']} pairs without complete labels",
        f"{100 * labelled:.1f} % of their pixels labelled, disparities {low:.1f} … {high:.1f} px, "
        f"rounded by at most {summary['disparity_rounding']['largest_px']:.4f} px",
        *(_quality_line(scene, found) for scene, found in summary["quality"]["scenes"].items()),
    ]
    flagged = summary["quality"]["flagged_tiles"]
    if flagged:
        some = ", ".join(f"{tile} ({gates})" for tile, gates in list(flagged.items())[:5])
        more = f" and {len(flagged) - 5} more" if len(flagged) > 5 else ""
        lines.append(f"Beyond the limits of quality: {some}{more}")
    else:
        lines.append("All labelled pairs are within the limits of quality")
    return [*lines, f"Look at {out_dir}/manifest.csv, {out_dir}/left, right, disp, status"]


def _quality_line(scene: str, found: Mapping[str, Any]) -> str:
    def px(name: str, sign: str = "") -> str:
        return "–" if found[name] is None else f"{found[name]:{sign}.2f} px"

    warp = found["warp_correlation"]
    return (
        f"{scene}: {found['sift_matches']} SIFT matches, error {px('sift_mean_error_px', '+')} "
        f"mean, {px('sift_mean_absolute_error_px')} mean absolute; y-parallax "
        f"{px('y_parallax_median_px', '+')} median; correlation with the warped right image "
        f"{'–' if warp is None else f'{warp:.3f}'}"
        + ("" if found["quality"] == "ok" else f"; beyond the limits: {found['quality']}")
    )


# -------------------------------------------------------------------------------- quick looks


def _draw_coverage(
    path: Path, city: str, rows: Sequence[Mapping[str, Any]], scans: Mapping[str, tuple]
) -> None:
    scenes = [
        (scene, figures.stretch(picture), mask, float(scale))
        for scene, (picture, mask, scale) in scans.items()
    ]
    tiles = [
        (r["scene"], r["row0"], r["col0"], r["size"], r["split"], r["complete"] == "yes")
        for r in rows
    ]
    count = sum(tile[5] for tile in tiles)
    title = f"{city}: {count} labelled pairs, {len(tiles) - count} without complete labels"
    figures.coverage_figure(path, title, scenes, tiles)


def _draw_contact_sheet(
    path: Path, city: str, rows: Sequence[Mapping[str, Any]], folder: Path, nodata: float
) -> None:
    labelled = [row for row in rows if row["complete"] == "yes"]
    picked = np.unique(np.linspace(0, len(labelled) - 1, CONTACT_TILES).round().astype(int))
    tiles = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        for row in (labelled[k] for k in picked):
            arrays = {}
            for kind in ("left", "right", "disp"):
                with rasterio.open(folder / row[kind]) as dataset:
                    arrays[kind] = dataset.read(1)
            step = max(1, row["size"] // 256)
            disparity = arrays["disp"][::step, ::step].astype(np.float32)
            disparity = np.where(disparity == nodata, np.nan, disparity)
            grey = [figures.shrink(figures.stretch(arrays[k]), 256) for k in ("left", "right")]
            tiles.append((row["tile"], *grey, disparity))
    values = np.concatenate([tile[3][np.isfinite(tile[3])] for tile in tiles])
    limits = tuple(float(v) for v in np.percentile(values, (1, 99)))
    title = f"{city}: {len(tiles)} of {len(labelled)} labelled pairs"
    figures.contact_sheet(path, title, tiles, limits)
