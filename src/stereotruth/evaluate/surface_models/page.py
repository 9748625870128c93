"""What a verdict over a surface model leaves: ``scores.json``, ``errors.csv``, ``index.html``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.products.files import atomic_folder, write_json, write_table
from ...lidar.height_raster import HeightRaster
from ...pages.figures import AXES, Chart, Plot, styled
from ...pages.page import way, write_page
from ...pages.pictures import (
    DIFFERENCES,
    SERIES,
    Picture,
    Scale,
    colours,
    encode,
    hillshade,
    shrink,
)
from ...pages.tables import Headline, minus, table, texts
from .edges import HIGH, LOW, SHARP, S
from .height_errors import OPEN
from .score import Verdict

MAP_BYTES = 250_000
MAP_PX = 700
TEMPLATE = Path(__file__).with_name("page.html.jinja")


def describe(figures: dict[str, Any]) -> str:
    """The verdict in one line."""
    moved, edges, errors = figures["registration"], figures["edges"], figures["errors"][OPEN]
    text = (
        f"{moved['east_m']:+.2f} m east, {moved['north_m']:+.2f} m north, {moved['up_m']:+.2f} m "
        f"up of its reference; then {errors['mean_absolute_m']:.2f} m mean absolute error {OPEN}, "
        f"{100 * errors['known_share']:.1f} % known"
    )
    if edges["position_error_m"] is not None:
        text += f"; edges of roofs {edges['position_error_m']:.2f} m off"
    return minus(text)


def write_verdict(
    verdict: Verdict, folder: str | Path, title: str, *, index: str | Path | None = None
) -> dict[str, Any]:
    """Write the folder, whole or not at all; returns what stands in ``scores.json``.

    ``index``: the page of all pages, for a link.
    """
    figures = verdict.figures()
    rows = [{"stratum": name, **of} for name, of in figures["errors"].items() if of["points"]]
    rows.append({"stratum": "as delivered, all but trees and water", **figures["as_delivered"]})
    with atomic_folder(folder) as scratch:
        write_json(scratch / "scores.json", figures)
        write_table(scratch / "errors.csv", rows)
        values = _values(verdict, figures, rows)
        values |= {"title": title, "index": way(Path(folder) / "index.html", index)}
        write_page(scratch / "index.html", TEMPLATE, values)
    return figures


@styled
def _profile(profile: list[float | None]) -> Chart:
    """The mean profile of the roofs' edges beside a sharp one."""
    plot = Plot.of("mean profile of the edges", "Beside a sharp edge (grey).", (5.6, 3.2))
    plot.axis.step(S, SHARP, where="mid", color=AXES)
    values = [np.nan if v is None else v for v in profile]
    (line,) = plot.axis.plot(S, values, marker=".", color=SERIES[0])
    known = [(s, v) for s, v in zip(S, values) if np.isfinite(v)]
    plot.hover(line, ["surface model"])
    plot.axis.set_xlabel("outward of the edge, m")
    plot.axis.set_ylabel(f"share of the step, {LOW:.0%} to {HIGH:.0%}")
    return plot.chart([{"outward_m": float(s), "share": v} for s, v in known])


def _shaded(model: HeightRaster) -> Picture:
    """Hillshade of the model, read at ``MAP_PX`` along its longer side."""
    heights, times = model.decimated(MAP_PX)
    return hillshade(heights / (times * np.mean(model.cell_m)), 1.0)


def _limit(verdict: Verdict) -> float:
    """Ends of the map's colours, m: what nine tenths of the differences keep, 0.5 at least."""
    size = np.abs(verdict.differences[np.isfinite(verdict.differences)])
    return max(float(np.ceil(20 * np.percentile(size, 90)) / 20), 0.5) if size.size else 0.5


def _values(
    verdict: Verdict, figures: dict[str, Any], rows: list[dict[str, Any]]
) -> dict[str, Any]:
    """What the page shows."""
    limit = _limit(verdict)
    picture = colours(verdict.differences, (-limit, limit), DIFFERENCES)
    return {
        "figures": figures,
        "links": [(name, name, "") for name in ("scores.json", "errors.csv")],
        "registration": _registration(figures["registration"]),
        "edges": figures["edges"],
        "table": table([texts(row) for row in rows]),
        "shaded": encode(_shaded(verdict.model), MAP_BYTES),
        "map": encode(shrink(picture, MAP_PX), MAP_BYTES),
        "profile": _profile(figures["edge_profile"]),
        "scale": Scale.of(DIFFERENCES, f"−{limit:.2f} m", f"+{limit:.2f} m"),
        "line": describe(figures),
    }


def _registration(found: dict[str, Any]) -> list[Headline]:
    """What is said of the model's place, with its standard uncertainty."""
    figures = (
        ("moved east", "east_m", "m"),
        ("moved north", "north_m", "m"),
        ("moved up", "up_m", "m"),
        ("tilt along east", "tilt_east_m_per_km", "m/km"),
        ("tilt along north", "tilt_north_m_per_km", "m/km"),
    )
    cards = []
    for title, name, unit in figures:
        sigma = found[f"sigma_{name}"]
        note = "" if sigma is None else f"± {sigma:.3f} {unit}"
        cards.append(Headline(title, minus(f"{found[name]:+.3f} {unit}"), note))
    return cards
