"""Figures of an alignment's residuals, and of a refinement by its table of tie points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.products.files import read_table
from ..core.products.rasters import image_shape, read_overview
from ..pages.pictures import DIFFERENCES, round_length, save_figure, stretch
from .alignment import Alignment, ViewFit

NAMES = ("disparity of LiDAR − that of the images", "y-parallax")
PICTURE_PX = 1024  # of the left image


def draw_residuals(alignment: Alignment, png_file: str | Path) -> None:
    """Vectors of the residuals on both images' frames, before and after the correction (PNG)."""
    figure = Figure(figsize=(11, 10.5), layout="constrained")
    axes = figure.subplots(2, 2)
    figure.suptitle(
        f"{alignment.scene or 'alignment'}: residuals of the ground control points, measured − "
        f"projected ({alignment.model})"
    )
    for k, fit in enumerate(alignment.fits):
        for ax, which, word in zip(axes[:, k], ("before", "after"), ("RPC alone", "corrected")):
            _draw_view(ax, fit, which, word)
    save_figure(png_file, figure)


def _draw_view(ax: Axes, fit: ViewFit, which: str, word: str) -> None:
    """The residuals ``before`` or ``after`` of one image over its frame."""
    used = [g for g in fit.gcps if g.used]
    if not used:
        ax.set_title(f"{fit.view}: no ground control points", loc="left", fontsize=10)
        ax.set_axis_off()
        return
    cols, rows = fit.size
    side = max(cols, rows)
    at = np.array([g.measured for g in used])
    vector = np.array([getattr(g, which) for g in used])
    # the longest takes an eighth of the frame
    _draw_arrows(ax, at, vector, vector, side / 8, 0.12)
    ax.plot(*at.T, "o", color="black", markersize=3, zorder=4)
    for g in fit.gcps:
        ax.annotate(
            g.id,
            g.measured,
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=8,
            color="0.25" if g.used else "C3",
        )
        if not g.used:
            ax.plot(*g.measured, "x", color="C3", markersize=9, mew=2, zorder=4)
    out = f", {len(fit.left_out)} left out (×)" if fit.left_out else ""
    ax.set_title(  # above the line of the arrow's key
        f"{fit.view}, {word}: rms {fit.rms(which):.3f} px{out}\n", loc="left", fontsize=10
    )
    ax.add_patch(Rectangle((-0.5, -0.5), cols, rows, fill=False, color="0.6"))
    ax.set_xlim(-0.06 * side, cols + 0.06 * side)
    ax.set_ylim(rows + 0.06 * side, -0.06 * side)
    ax.set(aspect="equal", xlabel="col (px)", ylabel="row (px)")


def _draw_arrows(
    ax: Axes, at: Floats, vector: Floats, scaled_by: Floats, length: float, key_at: float
) -> None:
    """Arrows [n, 2] px at places; the longest of ``scaled_by`` has a ``length`` in the plot."""
    longest = max(float(np.hypot(*scaled_by.T).max()), 1e-3)
    scale = {"angles": "xy", "scale_units": "xy", "scale": longest / length}
    arrows = ax.quiver(*at.T, *vector.T, color="C0", width=0.005, zorder=3, **scale)
    key = round_length(longest)
    ax.quiverkey(arrows, key_at, 1.03, key, f"{key:g} px", labelpos="E", coordinates="axes")


class _Ties(NamedTuple):
    """n tie points: ``site`` int[n]; place ``left`` [n, 2] in the left image and ``at`` [n, 2] in
    the epipolar grid, px; residuals (disparity, y-parallax) ``before``, ``after`` and
    ``by_affines`` alone [n, 2], px; which are ``used`` [n]."""

    site: Ints
    left: Floats
    at: Floats
    before: Floats
    after: Floats
    by_affines: Floats
    used: Bools

    @classmethod
    def read(cls, csv_file: str | Path) -> _Ties | None:
        """Of a table of :func:`.refine.write_refinement`; None of an empty one."""
        rows = list(read_table(csv_file))
        if not rows:
            return None

        def pairs(*names: str) -> Floats:
            return np.array([[float(row[f"{name}_px"]) for name in names] for row in rows])

        return cls(
            np.array([int(row["site"]) for row in rows]),
            pairs("left_col", "left_row"),
            pairs("epipolar_x", "epipolar_y"),
            *(
                pairs(f"disparity_{state}", f"y_parallax_{state}")
                for state in ("before", "after", "by_affines")
            ),
            np.array([row["used"] == "yes" for row in rows]),
        )


def draw_refinement(
    alignment: Alignment, csv_file: str | Path, png_file: str | Path, left_image: str | Path
) -> None:
    """Draw the tie points of a refined alignment (PNG), by their table (CSV) and the left image.

    Medians of the sites as vectors, tie points over the image, coloured by their residuals, and
    histograms of these; where lines are corrected, residuals by line. Without tie points the figure
    says why.
    """
    ties = _Ties.read(csv_file)
    record = alignment.refinement
    word = "applied" if record["applied"] else f"not applied: {record['reason']}"
    by_line = bool(record.get("by_line", {}).get("used"))
    figure = Figure(figsize=(11.5, 18.0 if by_line else 15.0), layout="constrained")
    figure.suptitle(f"{alignment.scene or 'alignment'}: refinement {word}")
    if ties is not None:
        axes = figure.subplots(3 + by_line, 2, height_ratios=(3, 3, 2, 2)[: 3 + by_line])
        _draw_sites(axes[0], ties)
        _draw_over_image(axes[1], ties, left_image)
        for k, (ax, name) in enumerate(zip(axes[2], ("disparity", "y_parallax"))):
            values = [state[ties.used, k] for state in (ties.before, ties.after)]
            bins = np.linspace(*np.percentile(np.concatenate(values), (0.5, 99.5)), 61)
            for state, v, colour in zip(("before", "after"), values, ("0.7", "C0")):
                f = record[state][name]
                label = f"{state}: median {f['median']:.3f}, rms {f['rms']:.3f}, "
                label += f"trend {f['trend_rms']:.3f} px"
                ax.hist(v, bins, color=colour, alpha=0.7, label=label)
            ax.axvline(0.0, color="black", linewidth=0.8)
            ax.set(xlabel=f"{NAMES[k]}, px", ylabel="tie points")
            ax.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
        if by_line:
            _draw_by_line(axes[3], ties)
    save_figure(png_file, figure)


def _draw_sites(axes: Sequence[Axes], ties: _Ties) -> None:
    """Medians of the sites' residuals as vectors in the epipolar grid, before and after."""
    sites = np.unique(ties.site[ties.used])
    members = [ties.used & (ties.site == site) for site in sites]
    at = np.array([np.median(ties.at[m], axis=0) for m in members])
    before, after = (
        np.array([np.median(values[m], axis=0) for m in members])
        for values in (ties.before, ties.after)
    )
    length = float(np.ptp(ties.at, axis=0).max()) / 10
    for ax, name, vector in zip(axes, ("before", "after"), (before, after)):
        _draw_arrows(ax, at, vector, before, length, 0.85)
        ax.plot(*ties.at[~ties.used].T, "x", color="C3", markersize=3, alpha=0.6)
        ax.set_title(f"{name}: medians of {len(sites)} sites (× blunders)", loc="left", fontsize=10)
        ax.set(xlabel="x in px of the epipolar grid", ylabel="y in px", aspect="equal")
        ax.invert_yaxis()


def _draw_over_image(axes: Sequence[Axes], ties: _Ties, left_image: str | Path) -> None:
    """Tie points over the left image, coloured by the residual of the disparity."""
    rows, cols = image_shape(left_image)
    picture = stretch(read_overview(left_image, PICTURE_PX))
    limit = max(float(np.percentile(np.abs(ties.before[:, 0]), 90)), 0.05)
    for ax, word, values in zip(axes, ("before", "after"), (ties.before[:, 0], ties.after[:, 0])):
        ax.imshow(picture, cmap="gray", extent=(-0.5, cols - 0.5, rows - 0.5, -0.5))
        shown = ax.scatter(
            *ties.left.T, c=values, cmap=DIFFERENCES, vmin=-limit, vmax=limit, s=9, linewidths=0
        )
        ax.set_title(f"{word}: over the left image", loc="left", fontsize=10)
        ax.set(xlabel="column in px of the left image", ylabel="row in px")
        ax.figure.colorbar(shown, ax=ax, label="disparity of LiDAR − that of the images, px")


def _draw_by_line(axes: Sequence[Axes], ties: _Ties) -> None:
    """Residuals by line of the left image: of the affines alone, and with corrections by line."""
    lines = ties.left[ties.used, 1]
    for k, (ax, name) in enumerate(zip(axes, NAMES)):
        for values, word, colour in (
            (ties.by_affines, "affines alone", "0.6"),
            (ties.after, "corrected by line", "C0"),
        ):
            ax.plot(lines, values[ties.used, k], ".", color=colour, markersize=3, label=word)
        ax.axhline(0.0, color="black", linewidth=0.8)
        ax.set(xlabel="line of the left image, px", ylabel=f"{name}, px")
        ax.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
