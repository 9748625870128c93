"""Resampling of a stereo pair into epipolar images: [y, x] Zarr grids of uint16, nodata 0.

Both images of a pair get the same grid and pixel size, so that rows correspond and
d = x_left - x_right is in px of that grid. The geometry is :mod:`stereotruth.epipolar`'s.
"""

from __future__ import annotations

import logging
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import dask
import numpy as np
import rasterio
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window

from .block_store import BlockStore, making
from .epipolar import EpipolarModel, Floats, ImageModel, fit_epipolar
from .errors import InputError
from .grid_store import Layer, Strip, blocks
from .provenance import digest, file_sha256, source_digest
from .rpc import SensorModel
from .runlog import BlockProgress

log = logging.getLogger("stereotruth")

SHARD = 1024  # px; one task writes one shard file
CHUNK = 256
LATTICE = 16  # px between exact source coordinates; in between they are bilinear
LATTICE_ERROR = 0.002  # px, accepted error of that
# Of waves of 6 px, Keys' six points leave 0.6 % rms, four points 2.1 %, Lanczos' eight 0.7 %; but
# Lanczos bends a ramp by 0.015 px, and OpenCV's remap rounds positions to 1/32 px.
RADIUS = 3  # px, of the interpolation kernel
ANTIALIAS = 1.2  # source px per epipolar px above which the kernel is widened
SIGMA_STEP = 512  # px between the nodes of the alignment's uncertainty
CACHE_MB = 256  # of decoded source; 1024 rows of a scene 34 000 px wide take 70
TILE = 64  # px; 64 x 64 px of float32 and their margins fit a cache of 32 KB
NO_WEIGHT = 1e-6  # of 65535: less than a tenth of a digital number
# Rows are taps, columns powers 3 to 0 of f: Keys' kernel at f + 2, f + 1, f, 1 - f, 2 - f, 3 - f
TAP_POLYNOMIALS = (
    np.array(
        [
            [1, -2, 1, 0],
            [-7, 15, -8, 0],
            [16, -28, 0, 12],
            [-16, 20, 8, 0],
            [7, -6, -1, 0],
            [-1, 1, 0, 0],
            [0, 0, 0, 0],
            [0, 0, 0, 0],
        ]
    )
    / 12
)
INT32 = ir.IntType(32)
LANES, LANE_NUMBERS = ir.VectorType(ir.FloatType(), 8), ir.VectorType(INT32, 8)
LabelSigma = Callable[[EpipolarModel, Any, Any], tuple[Floats, Floats, Floats]]
KERNEL = "cubic convolution, 6 x 6 taps (Keys 1981, fourth order), widened where downsampling"


# ------------------------------------------------------------------------------------- kernels


@njit(cache=True, nogil=True, error_model="numpy")
def _kernel(s: float) -> float:
    """Keys' six-point kernel (IEEE TASSP 29, 1981, section VI); reproduces cubic polynomials."""
    s = abs(s)
    if s < 1.0:
        return (4.0 * s - 7.0) * s * s / 3.0 + 1.0
    if s < 2.0:
        return ((-7.0 * s + 36.0) * s - 59.0) * s / 12.0 + 2.5
    if s < 3.0:
        return ((s - 8.0) * s + 21.0) * s / 12.0 - 1.5
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def tap_weights(at: float, first: int, scale: float, weights: Floats) -> None:
    """Weights of the source samples first, first + 1, … for the value at ``at``; sum 1."""
    if scale == 1.0:  # the same without branches
        f = at - first - 2.0
        e = 1.0 - f
        weights[0] = (((f - 2.0) * f + 1.0) * f) / 12.0
        weights[5] = (((e - 2.0) * e + 1.0) * e) / 12.0
        weights[1] = (((-7.0 * f + 15.0) * f - 8.0) * f) / 12.0
        weights[4] = (((-7.0 * e + 15.0) * e - 8.0) * e) / 12.0
        weights[2] = (4.0 * f - 7.0) * f * f / 3.0 + 1.0
        weights[3] = (4.0 * e - 7.0) * e * e / 3.0 + 1.0
        return
    total = 0.0
    for k in range(weights.size):
        weights[k] = _kernel((at - (first + k)) / scale)
        total += weights[k]
    for k in range(weights.size):
        weights[k] /= total


def _lanes(values: Iterable[float]) -> ir.Constant:
    return ir.Constant(LANES, [ir.Constant(ir.FloatType(), float(np.float32(v))) for v in values])


def _spread(builder: ir.IRBuilder, vector: ir.Value, lane: int) -> ir.Value:
    """All lanes hold the vector's lane ``lane``."""
    return builder.shuffle_vector(vector, vector, ir.Constant(LANE_NUMBERS, [lane] * 8))


def _polynomials(builder: ir.IRBuilder, f: ir.Value) -> ir.Value:
    """The weights of the taps at ``f``, by Horner's rule in all lanes."""
    first = builder.insert_element(ir.Constant(LANES, ir.Undefined), f, ir.Constant(INT32, 0))
    f = _spread(builder, first, 0)
    weights = _lanes(TAP_POLYNOMIALS[:, 0])
    for power in range(1, 4):
        weights = builder.fadd(builder.fmul(weights, f), _lanes(TAP_POLYNOMIALS[:, power]))
    return weights


@intrinsic
def six_by_six(typing, source, first, width, f_col, f_row):
    """The value of 6 x 6 taps, float32, from a flat image whose rows are ``width`` samples apart.

    ``first`` is the index of the upper-left tap; the position lies ``f_col``, ``f_row`` in [0, 1]
    past the third tap. Rows are read 8 samples wide, the last two with weight 0: NaN in any of
    them makes NaN.

    In vector instructions of its own: 64 M px/s in all; written out in Python, which Numba leaves
    scalar, 33; by gathers for 64 px at once, 47.
    """
    signature = types.float32(source, types.int64, types.int64, types.float32, types.float32)

    def generate(context, builder, signature, arguments):
        array, first, width, f_col, f_row = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        across, down = _polynomials(builder, f_col), _polynomials(builder, f_row)
        total = _lanes([0.0] * 8)
        for j in range(6):
            at = builder.add(first, builder.mul(width, ir.Constant(width.type, j)))
            line = builder.load(builder.bitcast(builder.gep(data, [at]), LANES.as_pointer()))
            line.align = 4
            total = builder.fadd(total, builder.fmul(line, _spread(builder, down, j)))
        total = builder.fmul(total, across)
        for shift in (4, 2, 1):
            turn = ir.Constant(LANE_NUMBERS, [(lane + shift) % 8 for lane in range(8)])
            total = builder.fadd(total, builder.shuffle_vector(total, total, turn))
        return builder.extract_element(total, ir.Constant(INT32, 0))

    return signature, generate


@njit(cache=True, nogil=True, error_model="numpy")
def _at_an_edge(
    source: NDArray[np.float32],
    row: int,
    col: int,
    f_row: np.float32,
    f_col: np.float32,
    patch: NDArray[np.float32],
) -> np.float32:
    """:func:`six_by_six` where samples are nodata or missing; those without weight do not count.

    (row, col) is the third tap. The same bits as without an edge where all samples are there.
    """
    down, across = np.empty(6), np.empty(6)
    tap_weights(f_row, -2, 1.0, down)
    tap_weights(f_col, -2, 1.0, across)
    patch[:] = 0.0
    for j in range(6):
        if abs(down[j]) < NO_WEIGHT:
            continue
        for i in range(6):
            if abs(across[i]) < NO_WEIGHT:
                continue
            r, c = row - 2 + j, col - 2 + i
            if r < 0 or c < 0 or r >= source.shape[0] or c >= source.shape[1]:
                return np.float32(np.nan)
            patch[j, i] = source[r, c]
    return six_by_six(patch.reshape(-1), 0, 8, f_col, f_row)


@njit(cache=True, nogil=True, error_model="numpy")
def _along_row(
    lattice: Floats, step: int, y: int, x: int, axis: int, whole: Floats, part: NDArray[np.float32]
) -> None:
    """Source positions of ``whole.size`` px from (x, y) on: whole px and the rest, in [0, 1].

    Bilinear between the lattice's nodes, relative to the whole px of the cell's first node: the
    same bits wherever the source's window begins.
    """
    j = y // step
    g = (y - j * step) / step
    k = 0
    while k < whole.size:
        i = (x + k) // step
        skip = x + k - i * step
        count = min(step - skip, whole.size - k)
        base = np.floor(lattice[axis, j, i])
        left = lattice[axis, j, i] - base + g * (lattice[axis, j + 1, i] - lattice[axis, j, i])
        right = (
            lattice[axis, j, i + 1]
            - base
            + g * (lattice[axis, j + 1, i + 1] - lattice[axis, j, i + 1])
        )
        slope = (right - left) / step
        for t in range(count):
            at = left + (skip + t) * slope
            down = np.floor(at)
            whole[k + t] = base + down
            part[k + t] = np.float32(at - down)
        k += count


@njit(cache=True, nogil=True, error_model="numpy")
def _resample(
    source: NDArray[np.float32], lattice: Floats, step: int, out: NDArray[np.uint16]
) -> int:
    """:func:`resample` without widening; a tile's source stays in the processor's cache."""
    rows, cols = source.shape
    flat = source.reshape(-1)
    patch = np.zeros((6, 8), dtype=np.float32)
    valid = 0
    for y0 in range(0, out.shape[0], TILE):
        for x0 in range(0, out.shape[1], TILE):
            width = min(TILE, out.shape[1] - x0)
            col, row = np.empty(width), np.empty(width)
            f_col, f_row = np.empty(width, np.float32), np.empty(width, np.float32)
            values = np.empty(width, np.float32)
            for y in range(y0, min(y0 + TILE, out.shape[0])):
                _along_row(lattice, step, y, x0, 0, col, f_col)
                _along_row(lattice, step, y, x0, 1, row, f_row)
                for k in range(width):
                    c, r = col[k], row[k]
                    value = np.float32(np.nan)
                    if c >= 2.0 and r >= 2.0 and c <= cols - 6.0 and r <= rows - 4.0:
                        first = (int(r) - 2) * cols + int(c) - 2
                        value = six_by_six(flat, first, cols, f_col[k], f_row[k])
                    if np.isnan(value) and (
                        c + f_col[k] >= -0.5
                        and r + f_row[k] >= -0.5
                        and c + f_col[k] <= cols - 0.5
                        and r + f_row[k] <= rows - 0.5
                    ):
                        value = _at_an_edge(source, int(r), int(c), f_row[k], f_col[k], patch)
                    values[k] = value
                for k in range(width):
                    value = np.floor(values[k] + np.float32(0.5))
                    value = min(max(value, np.float32(1.0)), np.float32(65535.0))
                    there = not np.isnan(values[k])
                    out[y, x0 + k] = np.uint16(value) if there else np.uint16(0)
                    valid += there
    return valid


@njit(cache=True, nogil=True, error_model="numpy")
def sample(
    source: NDArray[np.float32], first_row: int, first_col: int, down: Floats, across: Floats
) -> float:
    """Weighted sum of source samples; NaN where a sample with weight is nodata or missing."""
    rows, cols = source.shape
    if (
        first_row >= 0
        and first_col >= 0
        and first_row + down.size <= rows
        and first_col + across.size <= cols
    ):
        total = 0.0
        for j in range(down.size):
            part = 0.0
            for i in range(across.size):
                part += across[i] * source[first_row + j, first_col + i]
            total += down[j] * part
        if not np.isnan(total):
            return total
    total = 0.0  # at an edge or at nodata: samples without weight do not count
    for j in range(down.size):
        if abs(down[j]) < NO_WEIGHT:
            continue
        for i in range(across.size):
            if abs(across[i]) < NO_WEIGHT:
                continue
            r, c = first_row + j, first_col + i
            if r < 0 or c < 0 or r >= rows or c >= cols:
                return np.nan
            total += down[j] * across[i] * source[r, c]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _resample_widened(
    source: NDArray[np.float32],
    lattice: Floats,
    step: int,
    scale: tuple[float, float],
    out: NDArray[np.uint16],
) -> int:
    """:func:`resample` with a kernel of any width."""
    across = np.empty(2 * int(np.ceil(RADIUS * scale[0])))
    down = np.empty(2 * int(np.ceil(RADIUS * scale[1])))
    width = out.shape[1]
    col, row = np.empty(width), np.empty(width)
    f_col, f_row = np.empty(width, np.float32), np.empty(width, np.float32)
    valid = 0
    for y in range(out.shape[0]):
        _along_row(lattice, step, y, 0, 0, col, f_col)
        _along_row(lattice, step, y, 0, 1, row, f_row)
        for x in range(width):
            out[y, x] = 0
            if not (
                col[x] + f_col[x] >= -0.5
                and row[x] + f_row[x] >= -0.5
                and col[x] + f_col[x] <= source.shape[1] - 0.5
                and row[x] + f_row[x] <= source.shape[0] - 0.5
            ):
                continue
            before_col, before_row = 1 - across.size // 2, 1 - down.size // 2
            tap_weights(f_col[x], before_col, scale[0], across)
            tap_weights(f_row[x], before_row, scale[1], down)
            value = sample(source, int(row[x]) + before_row, int(col[x]) + before_col, down, across)
            if np.isnan(value):
                continue
            out[y, x] = np.uint16(min(max(np.floor(value + 0.5), 1.0), 65535.0))
            valid += 1
    return valid


@njit(cache=True, nogil=True, error_model="numpy")
def resample(
    source: NDArray[np.float32],
    lattice: Floats,
    step: int,
    scale: tuple[float, float],
    out: NDArray[np.uint16],
) -> int:
    """Fill ``out`` from ``source``; returns how many pixels got a value.

    ``source`` [row, col], C order, holds NaN for nodata. ``lattice`` [2, k, l] gives the source's
    (col, row) at every ``step``-th pixel of ``out``, first pixel included and past its end.
    ``scale`` is the widening of the kernel along (col, row), 1 for none. Nodata is 0, values are
    1 to 65535.
    """
    if scale[0] == 1.0 and scale[1] == 1.0:
        return _resample(source, lattice, step, out)
    return _resample_widened(source, lattice, step, scale, out)


# -------------------------------------------------------------------------------------- source


class Source:
    """One band of an image file, read by windows from any thread as float32 with NaN for nodata.

    Nodata is the file's nodata value, or exactly 0 if it names none. Integer images keep their
    digital numbers. Others keep theirs if their maximum lies in [256, 65535], else they are
    multiplied by ``gain`` = 10000 / maximum (of a decimated reading).

    Raises InputError if the file cannot be read or is complex-valued.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._local = threading.local()
        self._opened: list[rasterio.DatasetReader] = []
        self._lock = threading.Lock()
        dataset = self._dataset()
        self.size = (dataset.width, dataset.height)
        dtype = np.dtype(dataset.dtypes[0])
        if dtype.kind == "c":
            raise InputError(
                "complex image", file=path, remedy="give the amplitude as a real-valued image"
            )
        self.nodata = 0.0 if dataset.nodata is None else float(dataset.nodata)
        if dataset.count > 1:
            log.warning(
                "%s has %d bands; band 1 (%s) is used",
                self.path.name,
                dataset.count,
                dataset.descriptions[0] or dataset.colorinterp[0].name,
            )
        self.gain = 1.0
        if dtype.kind == "f":
            self.gain = self._float_gain(dataset)

    def _float_gain(self, dataset: rasterio.DatasetReader) -> float:
        shape = tuple(min(n, 2048) for n in dataset.shape)
        sample = dataset.read(1, out_shape=shape).astype(np.float64)
        sample = sample[np.isfinite(sample) & (sample != self.nodata)]
        top = float(sample.max()) if sample.size else 0.0
        if 256.0 <= top <= 65535.0 or top <= 0.0:
            return 1.0
        log.warning("%s: float values up to %g are scaled to 10000", self.path.name, top)
        return 10000.0 / top

    def _dataset(self) -> rasterio.DatasetReader:
        if not hasattr(self._local, "dataset"):
            with self._lock, warnings.catch_warnings():  # which is not thread-safe by itself
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                try:
                    dataset = rasterio.open(self.path)
                except RasterioError as error:
                    raise InputError(
                        f"not a raster that GDAL can read ({error})",
                        file=self.path,
                        remedy="check the path and the file",
                    ) from error
                self._opened.append(dataset)
                self._local.dataset = dataset
        return self._local.dataset

    def read(self, col: int, row: int, cols: int, rows: int) -> NDArray[np.float32]:
        """Window [rows, cols] from (col, row) on; must lie in the image."""
        try:
            raw = self._dataset().read(1, window=Window(col, row, cols, rows))
        except RasterioError as error:
            raise InputError(
                f"rows {row} to {row + rows} cannot be read ({error})",
                file=self.path,
                remedy="the file is damaged or cut short: get it again",
            ) from error
        values = raw.astype(np.float32)
        values[raw == self.nodata] = np.nan
        return values if self.gain == 1.0 else values * np.float32(self.gain)

    def close(self) -> None:
        """Close the handles of all threads."""
        for dataset in self._opened:
            dataset.close()

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# ---------------------------------------------------------------------------------- one image


def _lattice(model: ImageModel, rows: slice, cols: slice, step: int) -> Floats:
    """Source (col, row) [2, k, l] at every ``step``-th epipolar pixel of a block and past it."""
    y = np.arange(rows.start, rows.stop + step, step, dtype=np.float64)
    x = np.arange(cols.start, cols.stop + step, step, dtype=np.float64)
    return np.stack(model.inverse(x[None, :], y[:, None]))


def _lattice_step(model: ImageModel, shape: tuple[int, int]) -> tuple[int, float]:
    """Lattice spacing in px that keeps the error of bilinear coordinates small, and that error.

    The error, in source px, is taken at the middle of lattice cells all over the grid.
    """
    for step in (LATTICE, LATTICE // 2, LATTICE // 4, 1):
        y = np.linspace(0, shape[0] - 1, 33)[:, None]
        x = np.linspace(0, shape[1] - 1, 33)[None, :]
        corners = [
            np.stack(model.inverse(x + a * step, y + b * step)) for a in (0, 1) for b in (0, 1)
        ]
        exact = np.stack(model.inverse(x + step / 2, y + step / 2))
        error = float(np.nanmax(np.abs(sum(corners) / 4 - exact)))
        if error <= LATTICE_ERROR or step == 1:
            break
    return step, error


def _widening(model: ImageModel, shape: tuple[int, int]) -> tuple[float, float]:
    """Source px per epipolar px along (col, row), mid-grid, if above ANTIALIAS; else 1."""
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    col, row = model.inverse([x - 1, x + 1, x, x], [y, y, y - 1, y + 1])
    spans = [float(np.hypot(c[1] - c[0], c[3] - c[2]) / 2) for c in (col, row)]
    return tuple(span if span > ANTIALIAS else 1.0 for span in spans)


def rectify_image(
    source: Source,
    model: ImageModel,
    target: BlockStore,
    shape: tuple[int, int],
    *,
    key: str,
    workers: int,
    what: str = "rectified image",
    strip: Strip | None = None,
) -> dict[str, Any]:
    """Resample one image into its epipolar grid, block by block; returns facts for the attributes.

    A task reads the window of the source that its block needs; the result does not depend on
    ``workers`` or on the order of the tasks. Blocks that are there with the same ``key`` are taken
    over. ``strip``: only its blocks.

    Raises InputError if no pixel of the whole grid gets a value.
    """
    step, error = _lattice_step(model, shape)
    scale = _widening(model, shape)
    reach = [int(np.ceil(RADIUS * s)) + 1 for s in scale]

    def window(rows: slice, cols: slice) -> tuple[Floats, list[int]] | None:
        lattice = _lattice(model, rows, cols, step)
        bounds = []
        for axis in range(2):
            if not np.isfinite(lattice[axis]).any():
                return None
            low = int(np.floor(np.nanmin(lattice[axis]))) - reach[axis]
            high = int(np.ceil(np.nanmax(lattice[axis]))) + reach[axis] + 1
            low, high = max(low, 0), min(high, source.size[axis])
            if low >= high:
                return None
            bounds += [low, high - low]
        return lattice, bounds

    def run(rows: slice, cols: slice) -> None:
        found = window(rows, cols)
        if found is None:
            target.write((rows, cols), key, {}, 0)
            return
        lattice, (col, width, row, height) = found
        pixels = source.read(col, row, width, height)
        lattice[0] -= col
        lattice[1] -= row
        out = np.zeros((rows.stop - rows.start, cols.stop - cols.start), dtype=np.uint16)
        valid = resample(pixels, lattice, step, scale, out)
        target.write((rows, cols), key, {"image": out}, valid)

    every = blocks(shape, SHARD)
    part = every if strip is None else strip.of(every)
    # In the order of source rows, so that GDAL's cache serves neighbours in files of strips.
    todo = []
    for number in target.missing(part, [key] * len(part), workers):
        rows, cols = part[number]
        middle = model.inverse((cols.start + cols.stop) / 2, (rows.start + rows.stop) / 2)
        todo.append((float(np.nan_to_num(middle[1])) // SHARD, rows, cols))
    todo.sort(key=lambda item: item[0])
    tasks = [
        dask.delayed(run)(rows, cols, dask_key_name=f"block-{i:07d}")
        for i, (_, rows, cols) in enumerate(todo)
    ]
    with BlockProgress(len(tasks), what):
        dask.compute(*tasks, scheduler="threads", num_workers=workers)
    if strip is not None:
        return {}
    valid = int(sum(target.results(every)))
    if valid == 0:
        raise InputError(
            "image has nothing but nodata where the two images overlap",
            file=source.path,
            remedy=f"check the image (its nodata value is {source.nodata:g}) and its RPC",
        )
    log.info("%s: %.1f %% of the grid has a value", what, 100.0 * valid / (shape[0] * shape[1]))
    return {
        "source": source.path.name,
        "source_nodata": source.nodata,
        "value_gain": source.gain,
        "kernel": KERNEL,
        "kernel_widening_col_row": list(scale),
        "coordinate_error_px": round(error, 7),
        "valid_pixels": valid,
    }


# --------------------------------------------------------------------------------------- stage


def sigma_nodes(model: EpipolarModel, sigma: LabelSigma) -> dict[str, Any]:
    """Uncertainty of labels by the alignment at nodes of the epipolar grid, JSON-ready.

    ``step_px`` between nodes; ``disparity``, ``x``, ``y`` [row][col] in px, node (0, 0) at the
    centre of the upper-left pixel, the last ones at or past the grid's end.
    """
    rows, cols = (SIGMA_STEP * np.arange(-(-(n - 1) // SIGMA_STEP) + 1) for n in model.shape)
    values = sigma(model, cols[None, :], rows[:, None])
    nodes = {}
    for name, value in zip(("disparity", "x", "y"), values):
        worst = float(np.nanmax(value)) if np.isfinite(value).any() else 0.0
        nodes[name] = np.where(np.isfinite(value), value, worst).round(5).tolist()
    return {"step_px": SIGMA_STEP, **nodes}


def rectify(
    left_image: str | Path,
    right_image: str | Path,
    left_sensor: SensorModel,
    right_sensor: SensorModel,
    reference_height: float,
    epipolar_json: str | Path | None,
    left_store: str | Path,
    right_store: str | Path,
    *,
    workers: int = 1,
    height_range: tuple[float, float] | None = None,
    label_sigma: LabelSigma | None = None,
    provenance: Mapping[str, Any] | None = None,
    strip: Strip | None = None,
) -> EpipolarModel:
    """Fit the epipolar model of an aligned pair and resample both images into Zarr grids.

    Heights are ellipsoidal m; ``height_range`` defaults to the RPCs'. ``label_sigma`` is
    ``Alignment.label_sigma``, for the attribute ``alignment_sigma`` of the left grid. Grids hold
    ``image`` uint16 [y, x], 0 where there is no value; their attributes carry the model and
    ``provenance``. All three products appear when they are whole, or not at all.

    Blocks that an earlier call has left, made of the same images by the same model and code, are
    taken over (see :mod:`stereotruth.block_store`). ``strip``: make its blocks only,
    for a later call without it.

    Raises InputError for images that cannot be read, do not overlap, are one view, or hold nothing
    but nodata.
    """
    code = source_digest("rectification")
    with ExitStack() as stack:
        # GDAL's default, 5 % of the machine's memory, can be more than a job may use
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=CACHE_MB))
        left, right = (stack.enter_context(Source(path)) for path in (left_image, right_image))
        model = fit_epipolar(
            left_sensor,
            right_sensor,
            left.size,
            right.size,
            reference_height,
            height_range=height_range,
            names=(str(left_image), str(right_image)),
        )
        finished = []
        for view, source, image, store in (
            ("left", left, model.left_image, left_store),
            ("right", right, model.right_image, right_store),
        ):
            layer = Layer(
                dtype="uint16",
                fill=0,
                attrs={
                    "units": "1",
                    "long_name": f"digital numbers of the {view} epipolar image",
                    "nodata": 0,
                },
            )
            attrs = {
                "view": view,
                "epipolar": model.to_dict(),
                "provenance": dict(provenance or {}),
            }
            if label_sigma is not None and view == "left":
                attrs["alignment_sigma"] = sigma_nodes(model, label_sigma)
            grid = stack.enter_context(
                making(
                    store,
                    model.shape,
                    {"image": layer},
                    chunk=CHUNK,
                    shard=SHARD,
                    shared=strip is not None,
                )
            )
            made_of = {
                "image": file_sha256(source.path),
                "size": source.size,
                "model": image.to_dict(),
                "code": code,
            }
            attrs["resampling"] = rectify_image(
                source,
                image,
                grid,
                model.shape,
                key=digest(made_of),
                workers=workers,
                what=f"{view} epipolar image",
                strip=strip,
            )
            finished.append((grid, store, attrs))
        if strip is None:
            for grid, store, attrs in finished:
                grid.publish(store, blocks(model.shape, SHARD), attrs)
            if epipolar_json is not None:
                model.save(epipolar_json, provenance)
    return model
