"""How a scene is cut into overlapping blocks, what each of them sees, and how they are blended.

The left grid is cut into square blocks. A *tile* is what the method says of a block and of
``overlap`` px around it; for that it sees the images with the margins that it needs: ``margin_px``
to all sides and, along the row, the disparity range. The right part is moved by a whole number of
pixels, the tile's *offset*, so that a scene may have more relief than the method has range:
``d = offset + d_method``.

The offset is found from the images alone: both are reduced by averaging, and semi-global matching
over the whole search range tells the disparities of the reduced scene. The offset of a block is the
whole number of px with which most of its values lie in the method's range, and of these the one
nearest to their median: the tiles of a dataset, too, are cut with their mean disparity as offset.

Where tiles overlap, their disparities are averaged with weights that fall smoothly from one to the
other. By what two tiles differ on the whole, median by squares of ``CELL_PX`` (networks are off by
pixels, and by others for another offset), is shared out in full; of what is left, differences up
to ``SAME_PX``, and none from ``OTHER_PX`` on: then the tiles say different things (roof and
ground), nothing in between is true, and the block's own tile has the word, as it has on whether a
pixel is valid. Pixels that one of the images does not show are invalid.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stereotruth.core.errors import InputError

from .matcher import DisparityRange, Matcher
from .sgm import SemiGlobalMatcher

log = logging.getLogger("stereotruth")

Place = tuple[int, int]
Window = tuple[slice, slice]

BLOCK_PX = 1024
OVERLAP_PX = 64
PHASE_PX = 64  # parts begin at multiples: networks, on reduced grids, see all tiles in one phase

Disparities = NDArray[np.float32]

CELL_PX = 32
LARGEST_BIAS_PX = 8.0  # between tiles; what differs by more on the whole is left as it is
SAME_PX, OTHER_PX = 2.0, 4.0

REDUCED_PX = 2048  # longest side of the reduced images
MEDIAN = 5  # px, reduced
MIN_VALUES = 9  # reduced pixels with a disparity that a block must have
MIN_SHARE = 0.05  # of its reduced pixels that have an image
RESERVE_PX = 8  # kept free at both ends of the range: what the reduced scene does not show
NEARLY = 0.998  # of the most values in range are as good as most


@dataclass(frozen=True)
class Tiling:
    """Blocks of ``block`` px over a grid of ``shape``; tiles reach ``overlap`` px further.

    Places (i, j) count blocks along rows and columns. Raises ValueError if the overlap is more
    than half a block: no more than two tiles may meet along an axis.
    """

    shape: tuple[int, int]
    block: int = BLOCK_PX
    overlap: int = OVERLAP_PX

    def __post_init__(self) -> None:
        if not 0 <= 2 * self.overlap <= self.block:
            raise ValueError(f"overlap of {self.overlap} px for blocks of {self.block} px")

    @property
    def count(self) -> tuple[int, int]:
        """Number of blocks along rows and columns."""
        return -(-self.shape[0] // self.block), -(-self.shape[1] // self.block)

    @property
    def side(self) -> int:
        """Of a tile, px."""
        return self.block + 2 * self.overlap

    def places(self) -> Iterator[Place]:
        """All (i, j) in row-major order."""
        return ((i, j) for i in range(self.count[0]) for j in range(self.count[1]))

    def around(self, place: Place) -> list[Place]:
        """The places whose tiles reach into a block, its own among them."""
        ranges = (range(max(k - 1, 0), min(k + 2, n)) for k, n in zip(place, self.count))
        rows, cols = ranges
        return [(i, j) for i in rows for j in cols]

    def block_window(self, place: Place) -> Window:
        """[row, col] of a block."""
        starts = [k * self.block for k in place]
        return tuple(slice(s, min(s + self.block, n)) for s, n in zip(starts, self.shape))

    def common_window(self, place: Place, other: Place) -> Window:
        """[row, col] of what the tiles at two places have in common."""
        both = zip(self.tile_window(place), self.tile_window(other), self.shape)
        return tuple(slice(max(a.start, b.start, 0), min(a.stop, b.stop, n)) for a, b, n in both)

    def tile_window(self, place: Place) -> Window:
        """[row, col] of a tile; it may reach beyond the grid."""
        starts = [k * self.block - self.overlap for k in place]
        return tuple(slice(s, s + self.side) for s in starts)


@dataclass(frozen=True)
class View:
    """What a method needs to see of both images, [row, col] of each; the same shape.

    ``left`` may reach beyond the left image and ``right`` beyond the right one. ``inner`` is the
    wanted window within it.
    """

    left: Window
    right: Window
    inner: Window


def view_of(
    shape: tuple[int, int],
    window: Window,
    margin: int,
    disparity_range: DisparityRange,
    offset: int,
) -> View:
    """The view for a window of the left grid, cut to where one of the images has pixels."""
    rows, cols = window
    low, high = disparity_range
    top, bottom = max(rows.start - margin, 0), min(rows.stop + margin, shape[0])
    first = max(cols.start - margin - max(high, 0), min(0, offset))
    top, first = (start // PHASE_PX * PHASE_PX for start in (top, first))
    last = min(cols.stop + margin + max(-low, 0), shape[1] + max(0, offset))
    return View(
        left=(slice(top, bottom), slice(first, last)),
        right=(slice(top, bottom), slice(first - offset, last - offset)),
        inner=(
            slice(max(rows.start, 0) - top, min(rows.stop, shape[0]) - top),
            slice(max(cols.start, 0) - first, min(cols.stop, shape[1]) - first),
        ),
    )


def _part(image: Any, window: Window) -> NDArray[Any]:
    """A window of an image [h, w] or [h, w, bands] (NumPy, Dask, Zarr), 0 beyond it."""
    part = np.asarray(image[tuple(slice(max(w.start, 0), max(w.stop, 0)) for w in window)])
    whole = np.zeros((*(w.stop - w.start for w in window), *part.shape[2:]), part.dtype)
    if part.size:
        first = [max(-w.start, 0) for w in window]
        whole[tuple(slice(k, k + n) for k, n in zip(first, part.shape))] = part
    return whole


def _shown(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels that are not nodata."""
    return (image != 0).any(axis=2) if image.ndim == 3 else image != 0


def predict_tile(
    matcher: Matcher,
    images: tuple[Any, Any],
    tiling: Tiling,
    place: Place,
    disparity_range: DisparityRange,
    offset: int,
    *,
    margin_px: int | None = None,
    scaling: Any = None,
) -> Disparities:
    """The tile at a place, float32[side, side], NaN where invalid or beyond the grid.

    ``images``: left and right one (NumPy, Dask, Zarr). ``margin_px``: None: that of the method.
    """
    window = tiling.tile_window(place)
    margin = matcher.margin_px if margin_px is None else margin_px
    view = view_of(tiling.shape, window, margin, disparity_range, offset)
    left, right = (_part(image, of) for image, of in zip(images, (view.left, view.right)))
    tile = np.full((tiling.side, tiling.side), np.nan, dtype=np.float32)
    shown = _shown(left)[view.inner]
    in_right = _shown(right)
    if not (shown.any() and in_right.any()):
        return tile
    found = matcher(left, right, disparity_range, scaling)[view.inner]
    cols = np.arange(view.inner[1].start, view.inner[1].stop)
    with np.errstate(invalid="ignore"):
        there = np.floor(cols - found + 0.5)
        shown &= (there >= 0) & (there < right.shape[1])
    there = np.where(shown, there, 0).astype(np.intp)
    shown &= np.take_along_axis(in_right[view.inner[0]], there, axis=1)
    at = tuple(slice(max(-w.start, 0), max(-w.start, 0) + n) for w, n in zip(window, found.shape))
    tile[at] = np.where(shown, found + np.float32(offset), np.float32(np.nan))
    return tile


def _ramp(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """From 0 (t = -1) to 1 (t = 1), level at both ends."""
    t = np.clip(t, -1.0, 1.0)
    return 0.5 + 0.75 * t - 0.25 * t**3


def _weights(tiling: Tiling, axis: int, k: int) -> dict[int, NDArray[np.float64]]:
    """Weights of the tiles k - 1, k and k + 1 at the pixels of block k of an axis; sum 1."""
    window = tiling.block_window((k, k))[axis]
    at = np.arange(window.start, window.stop) + 0.5
    found = {k: np.ones(at.size)}
    if tiling.overlap and k > 0:
        found[k - 1] = 1.0 - _ramp((at - window.start) / tiling.overlap)
    if tiling.overlap and k + 1 < tiling.count[axis]:
        found[k + 1] = _ramp((at - window.stop) / tiling.overlap)
    for other in set(found) - {k}:
        found[k] = found[k] - found[other]
    return found


def difference_on_the_whole(
    tiling: Tiling, own: Place, other: Place, part: Callable[[Place, Window], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """By how much another tile differs from a block's own, px, over all that they have in common.

    ``part`` gives a tile's disparities in a window of the grid. Medians by squares, linear between
    their middles; 0 where they are beyond LARGEST_BIAS_PX. Seen from the other tile it is the same,
    negative: both sides of a seam meet.
    """
    window = tiling.common_window(own, other)
    difference = part(other, window) - part(own, window)
    shape = difference.shape
    counts = tuple(max(1, n // CELL_PX) for n in shape)
    edges = [np.linspace(0, n, k + 1).round().astype(int) for n, k in zip(shape, counts)]
    middles = np.zeros(counts)
    for i in range(counts[0]):
        for j in range(counts[1]):
            cell = difference[edges[0][i] : edges[0][i + 1], edges[1][j] : edges[1][j + 1]]
            known = cell[np.isfinite(cell)]
            if 4 * known.size >= cell.size:
                middles[i, j] = np.median(known)
    middles[np.abs(middles) > LARGEST_BIAS_PX] = 0.0
    for axis, (n, edge) in enumerate(zip(shape, edges)):
        at, of = np.arange(n) + 0.5, (edge[:-1] + edge[1:]) / 2
        middles = np.apply_along_axis(lambda v, at=at, of=of: np.interp(at, of, v), axis, middles)
    return middles


def blend(tiling: Tiling, place: Place, tiles: Mapping[Place, Any]) -> Disparities:
    """The block at a place from the tiles that reach into it, float32[h, w].

    ``tiles``: arrays [side, side] (NumPy or Zarr) of all places of :meth:`Tiling.around`.
    """
    rows, cols = tiling.block_window(place)

    def part(other: Place, window: Window) -> NDArray[np.float64]:
        of = tiling.tile_window(other)
        moved = tuple(slice(w.start - o.start, w.stop - o.start) for w, o in zip(window, of))
        return np.asarray(tiles[other][moved], dtype=np.float64)

    own = part(place, (rows, cols))
    change = np.zeros_like(own)
    for i, in_rows in _weights(tiling, 0, place[0]).items():
        for j, in_cols in _weights(tiling, 1, place[1]).items():
            if (i, j) == place:
                continue
            reached = [np.flatnonzero(weights > 0.0) for weights in (in_rows, in_cols)]
            if not all(map(len, reached)):
                continue
            r, c = (slice(int(at[0]), int(at[-1]) + 1) for at in reached)
            window = tuple(
                slice(o.start + w.start, o.start + w.stop) for o, w in zip((rows, cols), (r, c))
            )
            bias = difference_on_the_whole(tiling, place, (i, j), part)
            common = tiling.common_window(place, (i, j))
            at = tuple(slice(w.start - o.start, w.stop - o.start) for w, o in zip(window, common))
            rest = part((i, j), window) - own[r, c] - bias[at]
            same = np.clip((OTHER_PX - np.abs(rest)) / (OTHER_PX - SAME_PX), 0.0, 1.0)
            weight = in_rows[r, None] * in_cols[None, c]
            change[r, c] += weight * (bias[at] + np.nan_to_num(same * rest))
    return (own + change).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Offsets:
    """Offsets of the blocks, int64[n, m] px.

    ``known``: blocks [n, m] whose own images told it; others have that of the nearest known one.
    ``in_range``: share of the known blocks' values that lie in the range of their block.
    """

    offsets: NDArray[np.int64]
    known: NDArray[np.bool_]
    in_range: float


def reduced(image: Any, factor: int) -> NDArray[np.float32]:
    """An image [h, w] or [h, w, 3] averaged over squares of ``factor`` px; 0 is nodata.

    Squares with less than half of their pixels are nodata. Reads NumPy, Dask or Zarr by strips.
    """
    rows, cols = (-(-n // factor) for n in image.shape[:2])
    out = np.zeros((rows, cols), dtype=np.float32)
    step = max(1, 256 // factor)
    for first in range(0, rows, step):
        part = np.asarray(image[first * factor : (first + step) * factor]).astype(np.float32)
        if part.ndim == 3:
            part = part.mean(axis=2)
        tall, broad = part.shape
        pad = ((0, -tall % factor), (0, -broad % factor))
        part = np.pad(part, pad)
        cells = part.reshape(part.shape[0] // factor, factor, cols, factor)
        total, count = cells.sum(axis=(1, 3)), (cells != 0).sum(axis=(1, 3))
        good = 2 * count >= factor * factor
        out[first : first + step] = np.where(good, total / np.maximum(count, 1), 0.0)
    return out


def coarse_disparity(
    left: Any, right: Any, search: DisparityRange
) -> tuple[NDArray[np.float32], NDArray[np.bool_], int]:
    """Disparity in px of the full images on the reduced left one, where it has data, its factor.

    NaN where semi-global matching finds none.
    """
    longest = max(left.shape[:2])
    factor = max(1, math.ceil(longest / REDUCED_PX), min(4, longest // 512))
    small = [reduced(image, factor) for image in (left, right)]
    bounds = math.floor(search[0] / factor), math.ceil(search[1] / factor) + 1
    matcher = SemiGlobalMatcher(mode="sgbm", uniqueness_percent=10, speckle_px=50)
    found = matcher(*small, bounds) * np.float32(factor)
    known = np.isfinite(found)
    # a median of the known values: the unknown ones on either side balance each other
    low = ndimage.median_filter(np.where(known, found, -np.inf), MEDIAN)
    high = ndimage.median_filter(np.where(known, found, np.inf), MEDIAN)
    known &= np.isfinite(low) & np.isfinite(high)
    smooth = np.full(found.shape, np.nan, dtype=np.float32)
    smooth[known] = 0.5 * (low[known] + high[known])
    return smooth, small[0] != 0, factor


def best_offset(values: NDArray[Any], disparity_range: DisparityRange) -> tuple[int, float]:
    """The offset for a block's disparities, px, and the share of them that it brings in range."""
    values = np.sort(np.asarray(values, dtype=np.float64).ravel())
    low, high = disparity_range
    reserve = min(RESERVE_PX, (high - low) // 4)
    tried = np.arange(math.floor(values[0]) - high, math.ceil(values[-1]) - low + 1)
    inside = np.searchsorted(values, tried + high - reserve, "left")
    inside -= np.searchsorted(values, tried + low + reserve, "left")
    good = tried[inside >= NEARLY * inside.max()]
    middle = np.median(values)
    offset = int(good[np.argmin(np.abs(good - middle))])
    share = np.mean((values >= offset + low) & (values < offset + high))
    return offset, float(share)


def find_offsets(
    left: Any,
    right: Any,
    tiling: Tiling,
    disparity_range: DisparityRange,
    search: DisparityRange | None = None,
) -> Offsets:
    """Offsets of all blocks, from the images alone (NumPy, Dask or Zarr arrays; 0 is nodata).

    ``search``: disparities that the scene may have, px; None: up to a quarter of the width to
    either side. Raises InputError if the images nowhere match.
    """
    reach = left.shape[1] // 4
    search = search or (-reach, reach)
    coarse, imaged, factor = coarse_disparity(left, right, search)
    offsets = np.zeros(tiling.count, dtype=np.int64)
    known = np.zeros(tiling.count, dtype=np.bool_)
    shares = np.full(tiling.count, np.nan)
    count = hits = 0
    for place in tiling.places():
        window = tuple(
            slice(max(w.start, 0) // factor, -(-min(w.stop, n) // factor))
            for w, n in zip(tiling.tile_window(place), tiling.shape)
        )
        values = coarse[window]
        values = values[np.isfinite(values)]
        if values.size < max(MIN_VALUES, MIN_SHARE * imaged[window].sum()):
            continue
        offsets[place], shares[place] = best_offset(values, disparity_range)
        known[place] = True
        count += values.size
        hits += round(shares[place] * values.size)
    if not known.any():
        raise InputError(
            f"left and right image do not match anywhere between {search[0]} and {search[1]} px",
            remedy="check that they are an epipolar pair of one scene, or give the offset",
        )
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    found = Offsets(offsets[tuple(nearest)], known, hits / count)
    log.info(
        "offsets of the right image: %d to %d px in %d blocks; %.2f %% of the disparities of the "
        "scene, reduced %d times, lie in range",
        found.offsets.min(),
        found.offsets.max(),
        known.size,
        100.0 * found.in_range,
        factor,
    )
    poor = int((shares < 0.95).sum())
    if poor:
        log.warning(
            "in %d of %d blocks more than 5 %% of the ground lies beyond the range of %d px: take "
            "smaller blocks (predict.block_px) or a method with a wider range",
            poor,
            known.size,
            disparity_range[1] - disparity_range[0],
        )
    return found
