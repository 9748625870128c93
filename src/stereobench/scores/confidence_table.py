"""The methods that state uncertainties side by side: a table by stratum, and their curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereotruth.core.products.files import read_table
from stereotruth.pages.figures import Chart, Plot, look, styled

from .scores import ALL
from .tables import Table, nothing, plain_table

Row = Mapping[str, Any]
Curve = tuple[list[float], list[float], list[float]]
SHOWN = (50, 68.27, 90, 95)  # percent, of the intervals
NONE = "No method states the uncertainty of its disparities."
EXACT = ("exact_visible", "exact_hidden")


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
        return nothing("confidence", title, NONE)
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
        "AUSE, share of random",
        *(f"in {k:g} % interval (%)" for k in SHOWN),
        "width of 90 % (px)",
        "factor of σ",
    ]
    caption = (
        "Valid pixels with an uncertainty. AUSE: area between the sparsification curve and an "
        "oracle's, 0 at best; share of random: of the AUSE of uncertainties in random order. "
        "Factor of σ: the uncertainties times this factor hold 68.27 % of the errors."
    )
    return Table("confidence", title, rows, [(caption, plain_table(heading, lines))])


def read_curves(folder: str | Path) -> dict[str, Curve]:
    """Curves by stratum of a method's ``sparsification.csv``.

    Each has the share of pixels taken away (%), the mean error of the rest, and the oracle's (px).
    """
    found: dict[str, Curve] = {}
    for row in read_table(Path(folder) / "sparsification.csv"):
        values = (100 * float(row["removed_share"]), row["epe_px"], row["oracle_epe_px"])
        for column, value in zip(found.setdefault(row["stratum"], ([], [], [])), values):
            column.append(float(value))
    return found


@styled
def confidence_chart(methods: Sequence[Row], folders: Sequence[str | Path]) -> Chart | None:
    """The sparsification curves; None if no method states uncertainties.

    ``folders``: of the methods' scores. Of synthetic cities, axes for the visible pixels and for
    the hidden ones, by the exact truth; else for all. The oracle's curves are thin.
    """
    curves = {
        of["label"]: read_curves(folder) for of, folder in zip(methods, folders) if of["confidence"]
    }
    if not curves:
        return None
    names = [name for name in EXACT if any(name in of for of in curves.values())] or [ALL]
    plot = Plot.of(
        "sparsification",
        "Mean error of the pixels that are left when the most uncertain ones are taken away; thin: "
        "by an oracle.",
        (4.2 * len(names) + 1.0, 3.6),
        columns=len(names),
    )
    values = []
    for axis, name in zip(plot.axes[0], names):
        for number, (label, of) in enumerate(curves.items()):
            if name in of:
                style = look(number) | {"marker": "none"}
                share, stated, oracle = of[name]
                (line,) = axis.plot(share, stated, linewidth=2, label=label, **style)
                plot.hover(line, [label])
                axis.plot(share, oracle, color=style["color"], linewidth=0.7)
                columns = ("removed_percent", "epe_px", "oracle_epe_px")
                values += [
                    {"method": label, "pixels": name, **dict(zip(columns, row))}
                    for row in zip(share, stated, oracle)
                ]
        axis.set(xlabel="most uncertain pixels taken away, %", xlim=(0, 100))
        axis.set_title(f"pixels: {name.replace('_', ' ')}")
        axis.set_ylim(bottom=0)
    plot.axis.set_ylabel("mean error of the rest, px")
    plot.axis.legend()
    return plot.chart(values)


def _form(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)
