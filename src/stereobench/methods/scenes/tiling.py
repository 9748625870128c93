"""How a scene is cut into overlapping blocks, and the pieces of both images that a block sees.

Disparities of one block of a scene, and the blending of neighbouring blocks.

The left grid is cut into square blocks. A *tile* is what the method says of a block and of
``overlap`` px around it; for that it sees the images with the margins that it needs: ``margin_px``
to all sides and, along the row, the disparity range. The right part is moved by a whole number of
pixels, the tile's *offset*, so that a scene may have more relief than the method has range:
``d = offset + d_method``.

Where tiles overlap, their disparities are averaged with weights that fall smoothly from one to the
other. By what two tiles differ on the whole, median by squares of ``CELL_PX`` (networks are off by
pixels, and by others for another offset), is shared out in full; of what is left, differences up
to ``SAME_PX``, and none from ``OTHER_PX`` on: then the tiles say different things (roof and
ground), nothing in between is true, and the block's own tile has the word, as it has on whether a
pixel is valid. Pixels that one of the images does not show are invalid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..matcher import Matcher

Place = tuple[int, int]
Window = tuple[slice, slice]
DisparityRange = tuple[int, int]


BLOCK_PX = 1024
OVERLAP_PX = 64
PHASE_PX = 64  # parts begin at multiples: networks, on reduced grids, see all tiles in one phase


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


def inside(image: Any, window: Window) -> Any:
    """The part of an image [h, w] or [h, w, bands] (NumPy, Dask, Zarr) that a window meets."""
    rows, cols = window
    return image[
        max(rows.start, 0) : max(min(rows.stop, image.shape[0]), 0),
        max(cols.start, 0) : max(min(cols.stop, image.shape[1]), 0),
    ]


def extent_of(weights: NDArray[np.float64]) -> slice | None:
    """Where the weights are not 0."""
    found = np.flatnonzero(weights > 0.0)
    return slice(int(found[0]), int(found[-1]) + 1) if found.size else None


Disparities = NDArray[np.float32]


CELL_PX = 32
LARGEST_BIAS_PX = 8.0  # between tiles; what differs by more on the whole is left as it is
SAME_PX, OTHER_PX = 2.0, 4.0


def _padded(part: Any, window: Window, shape: tuple[int, int]) -> NDArray[Any]:
    """A part as :func:`.tiling.inside` gives it as the whole window, 0 beyond the image."""
    part = np.asarray(part)
    sizes = tuple(w.stop - w.start for w in window)
    if part.shape[:2] == sizes:
        return np.ascontiguousarray(part)
    whole = np.zeros((*sizes, *part.shape[2:]), dtype=part.dtype)
    at = tuple(slice(max(-w.start, 0), max(-w.start, 0) + n) for w, n in zip(window, part.shape))
    whole[at] = part
    return whole


def _shown(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels that are not nodata."""
    return (image != 0).any(axis=2) if image.ndim == 3 else image != 0


def predict_tile(
    matcher: Matcher,
    left: Any,
    right: Any,
    view: View,
    tiling: Tiling,
    place: Place,
    disparity_range: DisparityRange,
    offset: int,
    scaling: Any = None,
) -> Disparities:
    """The tile at a place, float32[side, side], NaN where invalid or beyond the grid.

    ``left``, ``right``: the parts of the images that the ``view`` meets (:func:`.tiling.inside`).
    """
    left = _padded(left, view.left, tiling.shape)
    right = _padded(right, view.right, tiling.shape)
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
    window = tiling.tile_window(place)
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
            r, c = (extent_of(w) for w in (in_rows, in_cols))
            if r is None or c is None:
                continue
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
