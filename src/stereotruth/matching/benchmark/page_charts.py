"""The charts of a benchmark's page: the distribution of errors, and errors by what pixels show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...pages.figures import HEIGHT, WIDTH, Axis, Chart, Point, Series, line, look
from ...pages.tables import metres
from ...products.files import read_table

Row = Mapping[str, Any]
LEAST_PX = 0.05  # of the axes of errors
ROW = 26.0  # units of a stratum's line


def cumulative_chart(methods: Sequence[Row], folders: Sequence[str | Path]) -> Chart:
    """Share of the pixels whose error is not above a limit, over the limit, for each method.

    ``folders``: of the scores, with ``cumulative.csv``, in the order of the methods.
    """
    x = Axis(LEAST_PX, 20.0, WIDTH, log=True)
    y = Axis(0.0, 100.0, HEIGHT, turned=True)
    series = []
    for number, (of, folder) in enumerate(zip(methods, folders)):
        rows = list(read_table(Path(folder) / "cumulative.csv"))
        points = [(float(row["error_px"]), 100 * float(row["share"])) for row in rows]
        colour, _, dash = look(number)
        series.append(Series(of["label"], colour, dash=dash, path=line(x, y, points)))
    return Chart(
        title="share of pixels below an error, by method",
        caption="All labelled pixels, holes filled: at a threshold, the share is 100 % less D1. "
        "The higher the better.",
        x_title="absolute error, px",
        y_title="% of the pixels below",
        x_ticks=x.ticks(),
        y_ticks=y.ticks(),
        series=tuple(series),
    )


LETTER = 6.8  # px, width of a letter of the names of strata, about


def strata_chart(methods: Sequence[Row]) -> Chart | None:
    """EPE by what the pixels show, with 95 % intervals; None of no strata."""
    names = list(dict.fromkeys(row["stratum"] for of in methods for row in of["strata"]))
    found = {of["method"]: {row["stratum"]: row for row in of["strata"]} for of in methods}
    values = [
        row["filled_epe_px"]
        for of in found.values()
        for row in of.values()
        if row["filled_epe_px"] is not None
    ]
    if not names or not values:
        return None
    most = max([*values, *(row.get("filled_epe_px_high") or 0 for of in found.values()
                           for row in of.values())])  # fmt: skip
    x = Axis(max(min(values) / 1.5, 1e-3), most * 1.3, WIDTH - 70, log=True)
    height = ROW * len(names)
    series = []
    for number, of in enumerate(methods):
        colour, shape, _ = look(number)
        points = []
        for k, name in enumerate(names):
            row = found[of["method"]].get(name)
            if row is None or row["filled_epe_px"] is None:
                continue
            offset = ROW * 0.6 * ((number + 0.5) / len(methods) - 0.5)
            low, high = row.get("filled_epe_px_low"), row.get("filled_epe_px_high")
            text = f"{of['label']}, {name.replace('_', ' ')}: {row['filled_epe_px']:.3f} px"
            if height_m := metres(row["filled_epe_px"], of.get("height_m_per_px")):
                text += f", {height_m}"
            if low is not None and high is not None:
                text += f" [{low:.3f}, {high:.3f}]"
            points.append(
                Point(
                    x.at(row["filled_epe_px"]),
                    round(ROW * (k + 0.5) + offset, 1),
                    text,
                    None if low is None else x.at(low),
                    None if high is None else x.at(high),
                )
            )
        series.append(Series(of["label"], colour, shape=shape, points=tuple(points)))
    return Chart(
        title="mean absolute error by what the pixels show, by method",
        caption="EPE of all labelled pixels, holes filled, with 95 % intervals by resampling "
        "tiles. Further left is better.",
        x_title="EPE, px",
        y_title="",
        x_ticks=x.ticks(),
        y_ticks=tuple((ROW * (k + 0.5), name.replace("_", " ")) for k, name in enumerate(names)),
        series=tuple(series),
        width=WIDTH - 70,
        height=height,
        left=max(126.0, LETTER * max(map(len, names))),
    )
