"""The figure of an alignment's residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..core.products.files import atomic_file
from ..pages.pictures import round_length
from .aligned_pair import Alignment


def draw_residuals(alignment: Alignment, png_file: str | Path) -> None:
    """Vectors of the residuals on both images' frames, before and after the correction (PNG)."""
    figure = Figure(figsize=(11, 10.5), layout="constrained")
    axes = figure.subplots(2, 2)
    figure.suptitle(
        f"{alignment.scene or 'alignment'}: residuals of the ground control points, measured − "
        f"projected ({alignment.model})"
    )
    for k, fit in enumerate(alignment.fits):
        cols, rows = fit.size
        side = max(cols, rows)
        for ax, which, word in zip(axes[:, k], ("before", "after"), ("RPC alone", "corrected")):
            used = [g for g in fit.gcps if g.used]
            if not used:
                ax.set_title(f"{fit.view}: no ground control points", loc="left", fontsize=10)
                ax.set_axis_off()
                continue
            at = np.array([g.measured for g in used])
            vector = np.array([getattr(g, which) for g in used])
            longest = max(float(np.hypot(*vector.T).max()), 1e-3)
            key = round_length(longest)
            # image px of the frame per px of residual: the longest takes an eighth of the frame
            width = {"angles": "xy", "scale_units": "xy", "scale": longest * 8 / side}
            arrows = ax.quiver(*at.T, *vector.T, color="C0", width=0.005, zorder=3, **width)
            ax.quiverkey(arrows, 0.12, 1.03, key, f"{key:g} px", labelpos="E", coordinates="axes")
            ax.plot(*at.T, "o", color="black", markersize=3, zorder=4)
            for g in fit.gcps:
                ax.annotate(
                    g.id,
                    g.measured,
                    xytext=(4, 4),
                    textcoords="offset points",
                    fontsize=8,
                    color="0.25" if g.used else "C3",
                    parse_math=False,  # a $ is no formula
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
            ax.set_aspect("equal")
            ax.set_xlabel("col (px)")
            ax.set_ylabel("row (px)")
    with atomic_file(png_file) as scratch:
        figure.savefig(scratch, dpi=110)
