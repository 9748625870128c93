"""The record of a refinement: JSON and a table of its tie points."""

from __future__ import annotations

import csv
from pathlib import Path

from ..core.products.files import atomic_file
from .adjustment import Observations
from .aligned_pair import Alignment

COLUMNS = (
    "site",
    "left_col_px",
    "left_row_px",
    "right_col_px",
    "right_row_px",
    "height_m",
    "epipolar_x_px",
    "epipolar_y_px",
    "correlation",
    "match_sigma_px",
    "used",
    "disparity_before_px",
    "y_parallax_before_px",
    "disparity_after_px",
    "y_parallax_after_px",
    "disparity_by_affines_px",
    "y_parallax_by_affines_px",
)


def write_refinement(
    alignment: Alignment,
    observations: Observations | None,
    json_file: str | Path,
    csv_file: str | Path,
) -> None:
    """Write a refined alignment (JSON) and its tie points (CSV); without any the table is empty."""
    with atomic_file(csv_file) as scratch:
        _write_table(observations, scratch)
    alignment.save(json_file)


def _write_table(observations: Observations | None, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        if observations is None:
            return
        ties = observations.ties
        found = ties.right + ties.shift
        residuals = observations.before, observations.after, observations.by_affines
        for k in range(len(ties)):
            row = [f"{v:.3f}" for v in (*ties.left[k], *found[k], ties.height[k])]
            row += [f"{v:.3f}" for v in observations.at[k]]
            row += [f"{ties.correlation[k]:.4f}", f"{ties.sigma[k]:.4f}"]
            row += ["yes" if observations.used[k] else "no"]
            row += [f"{v:.4f}" for values in residuals for v in values[k]]
            writer.writerow([ties.site[k], *row])
