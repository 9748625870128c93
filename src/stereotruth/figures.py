"""Quick looks: arrays to 8-bit pictures, panels, and the two figures of an exported city.

Disparities are drawn in ``turbo``; pixels without a value are dark grey.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import ArrayLike, NDArray

Picture = NDArray[np.uint8]
NO_VALUE = (64, 64, 64)
SPLIT_COLOURS = {"train": "#d62728", "val": "#ff9f1c", "test": "#8e44ad", "none": "#7f7f7f"}


def stretch(
    image: ArrayLike,
    *,
    nodata: float | None = 0,
    percent: tuple[float, float] = (1.0, 99.0),
    limits: tuple[float, float] | None = None,
) -> Picture:
    """Grey picture uint8[h, w] of an image, between percentiles (or ``limits``); nodata is 0."""
    image = np.asarray(image, dtype=np.float32)
    valid = np.isfinite(image) if nodata is None else np.isfinite(image) & (image != nodata)
    if not valid.any():
        return np.zeros(image.shape, np.uint8)
    low, high = limits or np.percentile(image[valid], percent)
    grey = np.clip((image - low) / max(high - low, 1e-9), 0.0, 1.0) * 254.0 + 1.0
    return np.where(valid, np.nan_to_num(grey), 0.0).astype(np.uint8)


def colours(
    values: ArrayLike, limits: tuple[float, float] | None = None, cmap: str = "turbo"
) -> Picture:
    """Colour picture uint8[h, w, 3]; NaN is dark grey, limits default to percentiles 1 and 99."""
    values = np.asarray(values, dtype=np.float32)
    valid = np.isfinite(values)
    if limits is None:
        limits = tuple(np.percentile(values[valid], (1, 99))) if valid.any() else (0.0, 1.0)
    low, high = limits
    scaled = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-9), 0.0, 1.0)
    picture = (colormaps[cmap](scaled)[..., :3] * 255.0 + 0.5).astype(np.uint8)
    picture[~valid] = NO_VALUE
    return picture


def shrink(picture: Picture, side: int) -> Picture:
    """A picture scaled down (area mean) so that its longer side is at most ``side`` px."""
    factor = side / max(picture.shape[:2])
    if factor >= 1.0:
        return picture
    width, height = (max(1, round(n * factor)) for n in picture.shape[1::-1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def round_length(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten at or below a positive value, for an arrow's key."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)) * power


def panels(rows: Sequence[Sequence[Picture]], gap: int = 4) -> Picture:
    """Grey and colour pictures side by side and below each other, on white."""
    height = [max(p.shape[0] for p in row) for row in rows]
    width = [max(row[k].shape[1] for row in rows if k < len(row)) for k in range(len(rows[0]))]
    sheet = np.full(
        (sum(height) + gap * (len(height) - 1), sum(width) + gap * (len(width) - 1), 3),
        255,
        np.uint8,
    )
    for r, row in enumerate(rows):
        top = sum(height[:r]) + gap * r
        for c, picture in enumerate(row):
            left = sum(width[:c]) + gap * c
            h, w = picture.shape[:2]
            sheet[top : top + h, left : left + w] = (
                picture if picture.ndim == 3 else picture[..., None]
            )
    return sheet


def save_figure(path: str | Path, figure: Figure, dpi: int = 110) -> None:
    """Write a matplotlib figure without any global state; no time or version goes into the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=dpi, metadata={"Software": None}, bbox_inches="tight")


def coverage_figure(
    path: str | Path,
    title: str,
    scenes: Sequence[tuple[str, Picture, NDArray[np.bool_], float]],
    tiles: Sequence[tuple[str, int, int, int, str, bool]],
) -> None:
    """Where the tiles of a city lie (figure 7 of the paper), one panel per scene.

    ``scenes``: (scene, grey picture of the rectified left image, labelled mask of the same
    shape, px of the epipolar grid per px of the picture). ``tiles``: (scene, row0, col0, size in
    px of the epipolar grid, split, complete).
    """
    tallest = max(grey.shape[0] / grey.shape[1] for _, grey, _, _ in scenes)
    figure = Figure(figsize=(7.0 * len(scenes), 6.2 * tallest + 1.4), layout="constrained")
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axis, (scene, grey, labelled, scale) in zip(axes, scenes):
        picture = np.repeat(grey[..., None], 3, axis=2)
        tint = np.array([40, 110, 255], np.float32)
        picture[labelled] = (0.6 * picture[labelled] + 0.4 * tint).astype(np.uint8)
        rows, cols = grey.shape
        axis.imshow(picture, extent=(-0.5, cols * scale - 0.5, rows * scale - 0.5, -0.5))
        for where, row0, col0, size, split, complete in tiles:
            if where == scene:
                inset = size / 80  # neighbours do not hide each other's colour
                axis.add_patch(
                    Rectangle(
                        (col0 - 0.5 + inset, row0 - 0.5 + inset),
                        size - 2 * inset,
                        size - 2 * inset,
                        fill=False,
                        linewidth=1.8 if complete else 1.0,
                        linestyle="-" if complete else "--",
                        edgecolor=SPLIT_COLOURS[split] if complete else "0.75",
                        zorder=3 if complete else 2,
                    )
                )
        axis.set(title=scene, xlabel="x in px of the epipolar grid", ylabel="y in px")
    legend = [Patch(fill=False, edgecolor=colour, label=s) for s, colour in SPLIT_COLOURS.items()]
    legend.append(Patch(fill=False, edgecolor="0.75", linestyle="--", label="incomplete pair"))
    legend.append(Patch(color=(0.45, 0.62, 1.0), label="labelled"))
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    figure.suptitle(title)
    save_figure(path, figure)


def contact_sheet(
    path: str | Path,
    title: str,
    tiles: Sequence[tuple[str, Picture, Picture, NDArray[np.floating]]],
    limits: tuple[float, float],
) -> None:
    """Tiles of a city: left, right and disparity in colour, two tiles to a line.

    ``tiles``: (caption, left, right, disparity in px with NaN), all small already.
    """
    lines = -(-len(tiles) // 2)
    figure = Figure(figsize=(13.0, 2.2 * lines + 0.8), layout="constrained")
    axes = figure.subplots(lines, 6, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for k, (caption, left, right, disparity) in enumerate(tiles):
        trio = axes[k // 2][3 * (k % 2) : 3 * (k % 2) + 3]
        for axis, grey, name in zip(trio, (left, right), ("left", "right")):
            axis.imshow(grey, cmap="gray", vmin=0, vmax=255)
            axis.set_title(f"{caption}, {name}" if name == "left" else name, fontsize=8)
        trio[2].imshow(colours(disparity, limits))
        trio[2].set_title("disparity", fontsize=8)
    mappable = ScalarMappable(cmap="turbo")
    mappable.set_clim(*limits)
    figure.colorbar(
        mappable, ax=axes, fraction=0.02, aspect=50, label="disparity, px (offset removed)"
    )
    figure.suptitle(title)
    save_figure(path, figure)
