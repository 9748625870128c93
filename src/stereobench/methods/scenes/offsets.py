"""By how much to move the right image, block by block, so that a method's range holds the ground.

Disparities over the relief of a scene may span many times a method's range. What a block needs to
know of its own is found from the images alone: both are reduced by averaging, and semi-global
matching over the whole search range tells the disparities of the reduced scene. It costs little
(they shrink with the image), and left-right check, uniqueness and a median leave hardly a wrong one
(:class:`Offsets` says how many of the blocks' values then lie in range). The offset of a block is
the whole number of px with which most of its values lie in the method's range, and of these the one
nearest to their median: the tiles of a dataset, too, are cut with their mean disparity as offset.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stereotruth.core.errors import InputError

from ..sgm import SemiGlobalMatcher
from .tiling import Tiling

log = logging.getLogger("stereotruth")
Ints = NDArray[np.int64]
DisparityRange = tuple[int, int]


REDUCED_PX = 2048  # longest side of the reduced images
MEDIAN = 5  # px, reduced
MIN_VALUES = 9  # reduced pixels with a disparity that a block must have
MIN_SHARE = 0.05  # of its reduced pixels that have an image
RESERVE_PX = 8  # kept free at both ends of the range: what the reduced scene does not show
NEARLY = 0.998  # of the most values in range are as good as most


@dataclass(frozen=True, eq=False)
class Offsets:
    """Offsets of the blocks, int64[n, m] px.

    ``known``: blocks [n, m] whose own images told it; others have that of the nearest known one.
    ``in_range``: share of the known blocks' values that lie in the range of their block.
    ``worst``: the smallest such share of a block, float64[n, m], NaN if not known.
    """

    offsets: Ints
    known: NDArray[np.bool_]
    in_range: float
    worst: NDArray[np.float64]


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
    found = Offsets(offsets[tuple(nearest)], known, hits / count, shares)
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
