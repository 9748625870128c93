"""A stereo method over images of any size: overlapping tiles, put together without seams.

For methods over images that lie in memory, or in Dask arrays; the package goes over scenes on the
disk (:mod:`stereobench.methods.predict_scene`), by the same tiles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereobench.methods.matcher import Matcher
from stereobench.methods.tiling import (
    BLOCK_PX,
    OVERLAP_PX,
    Disparities,
    Place,
    Tiling,
    blend,
    inside,
    predict_tile,
    view_of,
)

DisparityRange = tuple[int, int]


def match(
    matcher: Matcher,
    left: Any,
    right: Any,
    disparity_range: DisparityRange,
    *,
    block: int = BLOCK_PX,
    overlap: int = OVERLAP_PX,
    offset: str | int | NDArray[np.int64] = 0,
) -> Any:
    """Disparity of whole images [h, w] or [h, w, 3] of one shape, NumPy or Dask; 0 is nodata.

    Of NumPy arrays the disparity itself, float32[h, w] px (NaN: invalid); of Dask arrays a lazy
    array in chunks of ``block``, whose memory is that of some tiles. ``offset``: of the right
    image, px; one for all, one for each block [n, m], or "auto": found from the images, see
    :mod:`stereobench.methods.tiling`.
    """
    import dask
    import dask.array as da

    from stereobench.methods.tiling import find_offsets

    lazy = isinstance(left, da.Array)
    tiling = Tiling(tuple(left.shape[:2]), block, overlap)
    scaling = matcher.scaling(left, right)
    if isinstance(offset, str):
        offset = find_offsets(left, right, tiling, disparity_range).offsets
    offsets = np.broadcast_to(offset, tiling.count)
    tiles = {}
    for place in tiling.places():
        moved = int(offsets[place])
        view = view_of(
            tiling.shape, tiling.tile_window(place), matcher.margin_px, disparity_range, moved
        )
        tiles[place] = dask.delayed(predict_tile, pure=False)(
            matcher,
            inside(left, view.left),
            inside(right, view.right),
            view,
            tiling,
            place,
            disparity_range,
            moved,
            scaling,
        )
    rows = []
    for i in range(tiling.count[0]):
        row = []
        for j in range(tiling.count[1]):
            around = {place: tiles[place] for place in tiling.around((i, j))}
            found = dask.delayed(blend_lists, pure=False)(
                tiling, (i, j), list(around), list(around.values())
            )
            shape = tuple(w.stop - w.start for w in tiling.block_window((i, j)))
            row.append(da.from_delayed(found, shape, np.float32))
        rows.append(row)
    whole = da.block(rows)
    return whole if lazy else whole.compute(scheduler="synchronous")


def blend_lists(
    tiling: Tiling, place: Place, places: list[Place], tiles: list[Disparities]
) -> Disparities:
    """:func:`blend` for Dask, which looks for its tasks in lists, not in keys of mappings."""
    return blend(tiling, place, dict(zip((tuple(p) for p in places), tiles)))
