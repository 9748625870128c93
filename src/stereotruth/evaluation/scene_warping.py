"""Image warping over whole scenes: correlation of the left with the warped right image."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset.warped_tile import WarpedTile
from ..epipolar.warping import CorrelationSum, agreement, warp_window
from ..errors import InputError
from ..products.files import replacing
from ..products.grids import blocks, open_grid
from ..products.pictures import DIFFERENCES, DISPARITIES, NO_VALUE

BLOCK = 1024  # px


@dataclass
class SceneWarping:
    """Sums of left and warped right image, and counts of pixels: labelled, in the left image."""

    sums: CorrelationSum = field(default_factory=CorrelationSum)
    labelled: int = 0
    imaged: int = 0

    def merge(self, other: SceneWarping) -> None:
        """Add those of other pixels."""
        self.sums.merge(other.sums)
        self.labelled += other.labelled
        self.imaged += other.imaged


def warp_scene(left: str | Path, right: str | Path, disparity: str | Path) -> SceneWarping:
    """Warp a scene, given as left.zarr, right.zarr and disparity.zarr, block by block.

    Raises InputError for unfinished stores.
    """
    left_image, right_image = (open_grid(path)["image"] for path in (left, right))
    labels = open_grid(disparity)["disparity"]
    if not left_image.shape == right_image.shape == labels.shape:
        raise InputError(
            "images and disparity differ in size", file=disparity, remedy="run project again"
        )
    total = SceneWarping()
    for rows, cols in blocks(labels.shape, BLOCK):
        values = labels[rows, cols].values.astype(np.float64)
        warped = warp_window(right_image, values, rows, cols)
        reference = left_image[rows, cols].values.astype(np.float64)
        labelled = int(np.isfinite(values).sum())
        total.merge(
            SceneWarping(agreement(reference, warped), labelled, int((reference != 0).sum()))
        )
    return total


def evaluate_warping(left: str | Path, right: str | Path, disparity: str | Path) -> dict[str, Any]:
    """Correlation of left and warped right image over the labelled pixels of a scene.

    Takes and raises what :func:`warp_scene` does.
    """
    total = warp_scene(left, right, disparity).sums
    return {"pixels": total.count, "correlation": round(total.coefficient, 6)}


def draw_panels(tile: WarpedTile, path: str | Path) -> None:
    """PNG of the left image, the warped right one, their difference and the disparity.

    The difference is taken after a linear match of brightness.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 14.4), layout="constrained")
    axes = figure.subplots(2, 2)
    low, high = np.percentile(tile.left, (1, 99))
    difference = tile.left - tile.sums.match(tile.warped)
    spread = float(np.nanpercentile(np.abs(difference), 99)) if np.isfinite(difference).any() else 1
    gray = {"cmap": "gray", "vmin": low, "vmax": high}
    panels = (
        (tile.left, "left", gray),
        (tile.warped, f"warped right, correlation {tile.correlation:.3f}", gray),
        (
            difference,
            "left − warped right, brought to its brightness",
            {"cmap": DIFFERENCES, "vmin": -spread, "vmax": spread},
        ),
        (tile.disparity, "disparity (px)", {"cmap": DISPARITIES}),
    )
    for ax, (image, title, style) in zip(axes.ravel(), panels):
        ax.set_facecolor("black" if style is gray else np.array(NO_VALUE) / 255)
        shown = ax.imshow(image, interpolation="nearest", **style)
        ax.set_title(f"{tile.name}: {title}", parse_math=False)
        if style is not gray:
            figure.colorbar(shown, ax=ax, shrink=0.7)
    with replacing(path) as scratch:
        figure.savefig(scratch, dpi=75)
