"""The methods that state uncertainties side by side: a table by stratum, and their curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.figure import Figure

from ...products.files import read_table
from ...products.pictures import save_figure
from .scores import ALL
from .tables import Table

Row = Mapping[str, Any]
SHOWN = (50, 68.27, 90, 95)  # percent, of the intervals
NONE = "No method states the uncertainty of its disparities."
CURVES = {ALL: "-", "exact_visible": "-", "exact_hidden": ":"}  # of the figure, with their lines


def confidence_table(methods: Sequence[Row]) -> Table:
    """What the uncertainties of each method are worth, by stratum.

    ``methods``: summaries of one dataset. See :mod:`.confidence`.
    """
    title = "Confidence: stated uncertainties held against the errors"
    stated = [of for of in methods if of["confidence"]]
    rows = [
        {"method": of["label"], **row}
        for name in dict.fromkeys(row["stratum"] for of in stated for row in of["confidence"])
        for of in stated
        for row in of["confidence"]
        if row["stratum"] == name and row["pixels"]
    ]
    if not rows:
        return Table("confidence", title, [], [(NONE, ["Method"], [])])
    lines = [
        [
            f"{row['method']}, {row['stratum'].replace('_', ' ')}",
            f"{row['epe_px']:.3f}",
            f"{row['ause_px']:.3f}",
            _form(row["ause_share_of_random"], ".2f"),
            *(f"{100 * row[f'interval_{k:g}_percent_coverage_share']:.1f}" for k in SHOWN),
            f"{row['interval_90_percent_mean_width_px']:.2f}",
            f"{row['calibration_factor']:.2f}",
        ]
        for row in rows
    ]
    heading = [
        "Method, pixels",
        "EPE (px)",
        "AUSE (px)",
        "of ignorance",
        *(f"in {k:g} % interval (%)" for k in SHOWN),
        "width of 90 % (px)",
        "σ times",
    ]
    caption = (
        "Valid pixels with an uncertainty. AUSE: area between the sparsification curve and an "
        "oracle's, 0 at best; of ignorance: as a share of that of uncertainties that know nothing. "
        "σ times: what the uncertainties would have to be multiplied by for one σ to hold 68.27 %."
    )
    return Table("confidence", title, rows, [(caption, heading, lines)])


def draw_curves(path: str | Path, methods: Sequence[Row], folders: Sequence[str | Path]) -> bool:
    """PNG of the sparsification curves; returns whether any method has one.

    ``folders``: of the methods' scores, with ``sparsification.csv``. The oracle's are thin.
    """
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axis = figure.subplots()
    stated = [pair for pair in zip(methods, folders) if pair[0]["confidence"]]
    for place, (of, folder) in enumerate(stated):
        colour = colormaps["viridis"](place / max(len(stated), 2))
        rows = read_table(Path(folder) / "sparsification.csv")
        known = {row["stratum"] for row in rows}
        for stratum in [name for name in CURVES if name in known and _apart(name, known)]:
            curve = [row for row in rows if row["stratum"] == stratum]
            share = [100 * float(row["removed_share"]) for row in curve]
            name = f"{of['label']}, {stratum.replace('_', ' ')}"
            for key, width, label in (("epe_px", 1.8, name), ("oracle_epe_px", 0.7, None)):
                values = [float(row[key]) for row in curve]
                axis.plot(share, values, CURVES[stratum], color=colour, lw=width, label=label)
    axis.set(xlabel="most uncertain pixels taken away, %", ylabel="mean error of the rest, px")
    axis.set_xlim(0, 100)
    axis.set_ylim(bottom=0)
    if stated:
        axis.legend(title="thin: oracle", fontsize=8, title_fontsize=8, frameon=False)
    else:
        axis.text(50, 0.5, NONE, ha="center")
    save_figure(path, figure, dpi=120)
    return bool(stated)


def _apart(stratum: str, known: set[str]) -> bool:
    """Whether a curve shows other pixels than those of all: not the visible ones twice."""
    return stratum != ALL or "exact_visible" not in known


def _form(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)
