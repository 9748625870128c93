"""Image warping (section IV-A of the paper): the right image brought to the left by the disparity.

For each labelled left pixel (x, y), the right image is interpolated at (x − d, y), by cubic
convolution along the row (Keys 1981). How well left and warped right image agree is said by their
correlation coefficient over all labelled pixels of a scene or a tile.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from ..agreement import warp_rows
from ..errors import InputError
from ..grid_store import blocks, replacing, require_complete

Floats = NDArray[np.float64]
BLOCK = 1024  # px


@dataclass
class CorrelationSum:
    """Sums of two images' values, from which their correlation coefficient follows."""

    count: int = 0
    a: float = 0.0
    b: float = 0.0
    aa: float = 0.0
    bb: float = 0.0
    ab: float = 0.0

    def add(self, a: Floats, b: Floats) -> None:
        """Add pairs of finite values."""
        self.count += a.size
        self.a += float(a.sum())
        self.b += float(b.sum())
        self.aa += float((a * a).sum())
        self.bb += float((b * b).sum())
        self.ab += float((a * b).sum())

    def merge(self, other: CorrelationSum) -> None:
        """Add the sums of other pixels."""
        for name in ("count", "a", "b", "aa", "bb", "ab"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def coefficient(self) -> float:
        """Pearson's; NaN for fewer than two pairs or a constant image."""
        n = self.count
        if n < 2:
            return float("nan")
        va, vb = self.aa - self.a**2 / n, self.bb - self.b**2 / n
        if va <= 0 or vb <= 0:
            return float("nan")
        return (self.ab - self.a * self.b / n) / float(np.sqrt(va * vb))

    def match(self, b: Floats) -> Floats:
        """``b`` brought to the brightness of ``a`` by the linear regression of a on b."""
        n = max(self.count, 1)
        variance = self.bb - self.b**2 / n
        gain = (self.ab - self.a * self.b / n) / variance if variance > 0 else 1.0
        return gain * (b - self.b / n) + self.a / n


def warp_window(right: Any, disparity: Floats, rows: slice, cols: slice) -> Floats:
    """The right image (array [y, x], may be Zarr) in the left geometry of a window, NaN unlabelled.

    ``disparity`` float64[h, w] px of the window.
    """
    x = np.arange(cols.start, cols.stop)[None, :] - disparity
    known = np.isfinite(x)
    if not known.any():
        return np.full(disparity.shape, np.nan)
    first = max(int(np.floor(x[known].min())) - 2, 0)
    last = min(int(np.ceil(x[known].max())) + 3, right.shape[1])
    if last - first < 4:
        return np.full(disparity.shape, np.nan)
    part = np.asarray(right[rows, first:last], dtype=np.float64)
    return warp_rows(part, x - first)


def agreement(left: Floats, warped: Floats) -> CorrelationSum:
    """Sums over the pixels that both images show: left (0 is nodata), warped (NaN: none)."""
    total = CorrelationSum()
    good = np.isfinite(warped) & (left != 0)
    total.add(left[good], warped[good])
    return total


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
    left_image, right_image = (require_complete(path)["image"] for path in (left, right))
    labels = require_complete(disparity)["disparity"]
    if not left_image.shape == right_image.shape == labels.shape:
        raise InputError(
            "images and disparity differ in size", file=disparity, remedy="run project again"
        )
    total = SceneWarping()
    for rows, cols in blocks(labels.shape, BLOCK):
        values = labels[rows, cols].astype(np.float64)
        warped = warp_window(right_image, values, rows, cols)
        reference = left_image[rows, cols].astype(np.float64)
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


@dataclass(frozen=True, eq=False)
class WarpedTile:
    """An exported tile: left, warped right (NaN unlabelled) and disparity, float64[h, w]."""

    name: str
    left: Floats
    warped: Floats
    disparity: Floats

    @property
    def sums(self) -> CorrelationSum:
        """Of left and warped right image over the labelled pixels."""
        return agreement(self.left, self.warped)

    @property
    def correlation(self) -> float:
        """Coefficient of left and warped right image over the labelled pixels."""
        return self.sums.coefficient


def read_tile(path: Path) -> Floats:
    """The band of an exported TIFF, float64[h, w]; NaN where it is nodata."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            values = dataset.read(1).astype(np.float64)
            values[values == dataset.nodata] = np.nan
            return values


def warp_tile(tiles: str | Path, row: Mapping[str, str]) -> WarpedTile:
    """Warp an exported tile by its own disparity; ``row`` is its line of the manifest."""
    folder = Path(tiles)
    left, right, disparity = (read_tile(folder / row[kind]) for kind in ("left", "right", "disp"))
    x = np.arange(left.shape[1])[None, :] - disparity
    warped = warp_rows(np.nan_to_num(right), x)
    return WarpedTile(row["tile"], np.nan_to_num(left), warped, disparity)


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
            {"cmap": "RdBu", "vmin": -spread, "vmax": spread},
        ),
        (tile.disparity, "disparity (px)", {"cmap": "turbo"}),
    )
    for ax, (image, title, style) in zip(axes.ravel(), panels):
        ax.set_facecolor("black")
        shown = ax.imshow(image, interpolation="nearest", **style)
        ax.set_title(f"{tile.name}: {title}")
        if style is not gray:
            figure.colorbar(shown, ax=ax, shrink=0.7)
    with replacing(path) as scratch:
        figure.savefig(scratch, dpi=75)
