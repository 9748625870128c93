"""Windows of tile pairs in the grids of a scene.

The phase of each scene's tile grid (origin of its first window, in steps of about an eighth of a
tile) is that which gives most labelled pairs, then most pairs, then most labelled pixels.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job import progress
from ..core.numerics.windows import window_sums
from .scene_stores import SceneStores

MAX_RIGHT_NODATA = 0.01  # share of a right crop; ten columns of a slanted image border
OVERVIEW_PX = 1000  # longer side of the pictures in the coverage figure
REASONS = (
    "left image incomplete",
    "right crop outside the right image",
    "right image incomplete",
    "labels incomplete",
)


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
