"""The record of a refinement: JSON, a table of its tie points, and their figure."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rasterio.enums import Resampling

from ..products.files import atomic_file
from ..products.pictures import DIFFERENCES, save_figure, stretch
from ..products.rasters import open_raster
from .adjustment import Observations
from .aligned_pair import Alignment

PICTURE_PX = 1024  # of the left image, in the figure
COLUMNS = (
    "site",
    "left_col_px",
    "left_row_px",
    "right_col_px",
    "right_row_px",
    "height_m",
    "correlation",
    "match_sigma_px",
    "used",
    "disparity_before_px",
    "y_parallax_before_px",
    "disparity_after_px",
    "y_parallax_after_px",
)


def write_refinement(
    alignment: Alignment,
    observations: Observations | None,
    json_file: str | Path,
    csv_file: str | Path,
    png_file: str | Path,
    left_image: str | Path,
) -> None:
    """Write a refined alignment (JSON), its tie points (CSV) and their figure (PNG).

    The figure has the tie points over the left image, coloured by their residuals. Without
    observations the table is empty and the figure says why.
    """
    with atomic_file(csv_file) as scratch:
        _write_table(observations, scratch)
    with atomic_file(png_file) as scratch:
        _draw(alignment, observations, scratch, left_image)
    alignment.save(json_file)


def _write_table(observations: Observations | None, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        if observations is None:
            return
        ties = observations.ties
        found = ties.right + ties.shift
        for k in range(len(ties)):
            row = [f"{v:.3f}" for v in (*ties.left[k], *found[k], ties.height[k])]
            row += [f"{ties.correlation[k]:.4f}", f"{ties.sigma[k]:.4f}"]
            row += ["yes" if observations.used[k] else "no"]
            row += [f"{v:.4f}" for v in (*observations.before[k], *observations.after[k])]
            writer.writerow([ties.site[k], *row])


def _reduced(left_image: str | Path) -> NDArray[np.uint8]:
    """The first band of an image as a grey picture of PICTURE_PX at most on its longer side."""
    with open_raster(left_image) as source:
        step = max(1.0, max(source.shape) / PICTURE_PX)
        shape = tuple(max(int(n / step), 1) for n in source.shape)
        return stretch(source.read(1, out_shape=shape, resampling=Resampling.average))


def _draw_over_image(axes: Sequence[Axes], o: Observations, left_image: str | Path) -> None:
    """Tie points over the left image, coloured by the residual of the disparity."""
    picture = _reduced(left_image)
    with open_raster(left_image) as source:
        rows, cols = source.shape
    limit = max(float(np.percentile(np.abs(o.before[:, 0]), 90)), 0.05)
    for ax, word, values in zip(axes, ("before", "after"), (o.before[:, 0], o.after[:, 0])):
        extent = (-0.5, cols - 0.5, rows - 0.5, -0.5)
        ax.imshow(picture, cmap="gray", extent=extent)
        shown = ax.scatter(
            *o.ties.left.T, c=values, cmap=DIFFERENCES, vmin=-limit, vmax=limit, s=9, linewidths=0
        )
        ax.set_title(f"{word}: over the left image", loc="left", fontsize=10)
        ax.set(xlabel="column in px of the left image", ylabel="row in px")
        ax.figure.colorbar(shown, ax=ax, label="disparity of LiDAR − that of the images, px")


def _draw(
    alignment: Alignment, observations: Observations | None, path: Path, left_image: str | Path
) -> None:
    """Medians of the sites as vectors, tie points over the image, histograms of the residuals."""
    record = alignment.refinement
    word = "applied" if record["applied"] else f"not applied: {record['reason']}"
    figure = Figure(figsize=(11.5, 15.0), layout="constrained")
    figure.suptitle(f"{alignment.scene or 'alignment'}: refinement {word}")
    if observations is None:
        save_figure(path, figure)
        return
    axes = figure.subplots(3, 2, height_ratios=(3, 3, 2))
    _draw_over_image(axes[1], observations, left_image)
    used, ties = observations.used, observations.ties
    states = {"before": observations.before, "after": observations.after}
    sites = np.unique(ties.site[used])
    members = [used & (ties.site == site) for site in sites]
    at = np.array([np.median(observations.at[m], axis=0) for m in members])
    side = float(np.ptp(observations.at, axis=0).max())
    vectors = {
        name: np.array([np.median(values[m], axis=0) for m in members])
        for name, values in states.items()
    }
    longest = max(float(np.hypot(*vectors["before"].T).max()), 1e-3)
    key = float(f"{longest:.1g}")
    for ax, (name, vector) in zip(axes[0], vectors.items()):
        arrows = ax.quiver(
            *at.T,
            *vector.T,
            angles="xy",
            scale_units="xy",
            scale=longest * 10 / side,
            color="C0",
            width=0.005,
        )
        ax.quiverkey(arrows, 0.85, 1.03, key, f"{key:g} px", labelpos="E", coordinates="axes")
        ax.plot(*observations.at[~used].T, "x", color="C3", markersize=3, alpha=0.6)
        ax.set_title(f"{name}: medians of {len(sites)} sites (× blunders)", loc="left", fontsize=10)
        ax.set(xlabel="x in px of the epipolar grid", ylabel="y in px", aspect="equal")
        ax.invert_yaxis()
    names = ("disparity of LiDAR − that of the images", "y-parallax")
    for k, (ax, name, figures) in enumerate(zip(axes[2], names, ("disparity", "y_parallax"))):
        values = [state[used, k] for state in states.values()]
        bins = np.linspace(*np.percentile(np.concatenate(values), (0.5, 99.5)), 61)
        for (state, _), v, colour in zip(states.items(), values, ("0.7", "C0")):
            f = record[state][figures]
            ax.hist(
                v,
                bins,
                color=colour,
                alpha=0.7,
                label=f"{state}: median {f['median']:.3f}, rms {f['rms']:.3f}, "
                f"trend {f['trend_rms']:.3f} px",
            )
        ax.axvline(0.0, color="black", linewidth=0.8)
        ax.set(xlabel=f"{name}, px", ylabel="tie points")
        ax.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    save_figure(path, figure)
