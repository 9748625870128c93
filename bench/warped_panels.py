"""Pictures of a tile: left, warped right, their difference, disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereotruth.dataset.warped_tile import WarpedTile
from stereotruth.pages.pictures import DIFFERENCES, DISPARITIES, NO_VALUE
from stereotruth.products.files import atomic_file


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
    with atomic_file(path) as scratch:
        figure.savefig(scratch, dpi=75)
