"""A stereo method over images of any size: overlapping tiles, put together without seams.

For images that lie in memory; the package goes over scenes on the disk
(:mod:`stereobench.methods.predict_scene`), by the same tiles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereobench.methods.matcher import Matcher
from stereobench.methods.tiling import (
    BLOCK_PX,
    OVERLAP_PX,
    Tiling,
    blend,
    find_offsets,
    predict_tile,
)


def match(
    matcher: Matcher,
    left: NDArray,
    right: NDArray,
    disparity_range: tuple[int, int],
    *,
    block: int = BLOCK_PX,
    overlap: int = OVERLAP_PX,
    offset: str | int | NDArray[np.int64] = 0,
) -> NDArray[np.float32]:
    """Disparity float32[h, w] px of whole images [h, w] or [h, w, 3] of one shape; 0 is nodata.

    ``offset``: of the right image, px; one for all, one for each block [n, m], or "auto": found
    from the images.
    """
    tiling = Tiling(tuple(left.shape[:2]), block, overlap)
    scaling = matcher.scaling(left, right)
    if isinstance(offset, str):
        offset = find_offsets(left, right, tiling, disparity_range).offsets
    offsets = np.broadcast_to(offset, tiling.count)
    tiles = {
        p: predict_tile(
            matcher, (left, right), tiling, p, disparity_range, int(offsets[p]), scaling=scaling
        )
        for p in tiling.places()
    }
    rows, cols = tiling.count
    return np.block([[blend(tiling, (i, j), tiles) for j in range(cols)] for i in range(rows)])
