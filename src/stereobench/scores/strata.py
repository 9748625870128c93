"""Where methods differ: the labelled pixels of a tile, divided by what they show.

==================  ================================================================================
near_step           labels within ``NEAR_PX`` differ by more than ``STEP_PX`` (any dataset)
match_inside,       whether the right tile holds the pixel's match, by its label; where it does not,
match_outside       a method can but guess (any dataset)
near_occlusion      a pixel that only one view sees lies within ``NEAR_PX`` (by the tile's status)
ground, vegetation,
building, other     by the class of the LiDAR point that gave the label (layer ``class``)
agl_…               by its height above the ground, ``AGL_M`` (layer ``agl``)
uncertainty_…       by the label's standard uncertainty, ``UNCERTAINTY_PX`` (layer ``uncertainty``)
exact_visible       against a synthetic city's exact truth: all pixels that both views see and that
                    are unchanged and no water, labelled or not
exact_hidden        likewise, pixels behind something in the right view
==================  ================================================================================

Layers are those of the dataset (``tiles.layers``). Classes of a dataset without that layer, and all
else but the first three, come from products of the workflow, of which the dataset's manifest names
the tile, scene and window; what is missing is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zarr
from numpy.typing import NDArray

from stereotruth.core.numerics.arrays import Bools
from stereotruth.core.products.grids import require_complete
from stereotruth.core.products.rasters import read_flags
from stereotruth.core.status import HIDDEN
from stereotruth.tiles.manifest import Tile, column
from stereotruth.tiles.orientation import PixelSize
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset, match_inside

NEAR_PX = 5
STEP_PX = 3.0
FAR_PX = np.float32(1e6)  # beyond any disparity
WATER = 5  # of the layer surface of the exact truth
AGL_M = (2.0, 10.0, 30.0)  # bounds: low things, houses and trees, blocks, towers
UNCERTAINTY_PX = (0.05, 0.1, 0.2)
LAYERS = ("class", "agl", "uncertainty")  # of ``tiles.layers``
CLASSES = {"ground": (2,), "vegetation": (3, 4, 5), "building": (6,)}  # ASPRS


@dataclass(frozen=True)
class Products:
    """Folders of the workflow that a dataset was made of: tiles, results/project, results/truth."""

    tiles: Path | None = None
    project: Path | None = None
    truth: Path | None = None

    def hidden(self, pair: Pair) -> Bools | None:
        """Pixels of a tile that only one view sees."""
        if self.tiles is None or not pair.row:
            return None
        prefix, _, number = pair.row["tile"].rpartition("_")
        file = self.tiles / pair.city / "status" / f"{prefix}_status_{number}.tiff"
        if not file.is_file():
            return None
        status, meanings = read_flags(file)
        return np.isin(status, [value for value, name in meanings.items() if name in HIDDEN])

    def grid(self, folder: Path | None, pair: Pair) -> zarr.Group | None:
        """The store of a pair's scene in one of the folders."""
        if folder is None or not pair.row:
            return None
        store = folder / pair.city / f"{pair.row['scene']}.zarr"
        return require_complete(store) if store.is_dir() else None


def height_m_per_px(pairs: Sequence[Pair], products: Products) -> float | None:
    """Metres of height for one px of disparity, mean of the pairs; None where no tile tells."""
    if products.tiles is None:
        return None
    files = (
        products.tiles / pair.city / "orientation" / f"{pair.row['tile']}.json"
        for pair in pairs
        if pair.row
    )
    size = PixelSize.mean(files)
    return None if size is None else round(size.height_m, 4)


def layers_of(dataset: StereoDataset, pair: Pair) -> dict[str, NDArray[Any]]:
    """Those of LAYERS that a pair has, [h, w]: m, px, LAS classes."""
    return {name: dataset.layer(pair, name) for name in LAYERS if pair.row.get(column(name))}


def label_strata(
    pair: Pair,
    labels: NDArray[np.float32],
    products: Products,
    layers: Mapping[str, NDArray[Any]] | None = None,
) -> dict[str, Bools]:
    """Masks [h, w] of the strata of a pair's labels (float32, NaN unlabelled).

    ``layers``: see :func:`layers_of`.
    """
    layers, inside = layers or {}, match_inside(labels)
    found = {
        "near_step": near_step(labels),
        "match_inside": inside,
        "match_outside": np.isfinite(labels) & ~inside,
    }
    hidden = products.hidden(pair)
    if hidden is not None:
        found["near_occlusion"] = cv2.dilate(hidden.astype(np.uint8), _square()) > 0
    classes = layers.get("class")
    if classes is None and (grid := products.grid(products.project, pair)) is not None:
        classes = grid["surface_class"][Tile.of(pair.row).window]
    if classes is not None:
        for name, codes in CLASSES.items():
            found[name] = np.isin(classes, codes)
        found["other"] = ~np.any([found[name] for name in CLASSES], axis=0)
    if "agl" in layers:
        found |= by_bins("agl", layers["agl"], AGL_M, "m")
    if "uncertainty" in layers:
        found |= by_bins("uncertainty", layers["uncertainty"], UNCERTAINTY_PX, "px")
    return found


def by_bins(
    name: str, values: NDArray[Any], bounds: Sequence[float], unit: str
) -> dict[str, Bools]:
    """Masks of values below, between and from the bounds on; NaN is in none of them."""
    low, *between, high = zip((-np.inf, *bounds), (*bounds, np.inf))
    masks = {f"{name}_below_{low[1]:g}_{unit}": values < low[1]}
    for start, end in between:
        masks[f"{name}_{start:g}_to_{end:g}_{unit}"] = (values >= start) & (values < end)
    return masks | {f"{name}_from_{high[0]:g}_{unit}": values >= high[0]}


def exact_truth(pair: Pair, products: Products) -> dict[str, NDArray[np.float32]]:
    """Exact disparity of a synthetic pair by stratum, NaN elsewhere; empty without the truth."""
    grid = products.grid(products.truth, pair)
    if grid is None:
        return {}
    tile = Tile.of(pair.row)
    here = tile.window
    layer: dict[str, Any] = {name: grid[name][here] for name in ("changed", "changed_right")}
    same = (
        (layer["changed"] == 0) & (layer["changed_right"] == 0) & (grid["surface"][here] != WATER)
    )
    disparity = grid["disparity"][here] - np.float32(tile.right_offset_px)
    return {
        f"exact_{name}": np.where(same & (grid[name][here] == 1), disparity, np.nan)
        for name in ("visible", "hidden")
    }


def near_step(labels: NDArray[np.float32]) -> Bools:
    """Whether the labels around each pixel differ by a step."""
    known = np.isfinite(labels)
    high = cv2.dilate(np.where(known, labels, -FAR_PX), _square())
    low = cv2.erode(np.where(known, labels, FAR_PX), _square())
    return known & (high - low > STEP_PX)


def _square() -> NDArray[np.uint8]:
    return np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)
