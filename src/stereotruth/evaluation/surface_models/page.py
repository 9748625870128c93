"""What a verdict over a surface model leaves: ``scores.json``, ``errors.csv``, ``index.html``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...lidar.height_raster import HeightRaster
from ...pages.page import way, write_page
from ...pages.pictures import (
    Picture,
    colours,
    encode,
    encode_file,
    gradient,
    hillshade,
    save_figure,
    shrink,
)
from ...pages.tables import Headline, minus, table
from ...products.files import atomic_folder, write_json, write_table
from .edges import HIGH, LOW, SHARP, S
from .height_errors import OPEN
from .score import Verdict

MAP_BYTES, FIGURE_BYTES = 250_000, 60_000
MAP_PX = 700
COLOURS = "RdYlBu_r"
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
        _draw_profile(scratch / "edges.png", figures["edge_profile"])
        values = _values(verdict, figures, rows, scratch)
        values |= {"title": title, "index": way(Path(folder) / "index.html", index)}
        write_page(scratch / "index.html", TEMPLATE, values)
    return figures


def _draw_profile(path: Path, profile: list[float | None]) -> None:
    """The mean profile of the roofs' edges beside a sharp one."""
    figure = Figure(figsize=(5.2, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.step(S, SHARP, where="mid", color="0.6", label="reference")
    values = [np.nan if v is None else v for v in profile]
    axes.plot(S, values, marker=".", color="C3", label="surface model")
    axes.set_xlabel("outward of the edge, m")
    axes.set_ylabel(f"share of the step, {LOW:.0%} to {HIGH:.0%}")
    axes.legend(frameon=False)
    save_figure(path, figure)


def _shaded(model: HeightRaster) -> Picture:
    """Hillshade of the model, read at ``MAP_PX`` along its longer side."""
    heights, times = model.decimated(MAP_PX)
    return hillshade(heights / (times * np.mean(model.cell_m)), 1.0)


def _limit(verdict: Verdict) -> float:
    """Ends of the map's colours, m: what nine tenths of the differences keep, 0.5 at least."""
    size = np.abs(verdict.differences[np.isfinite(verdict.differences)])
    return max(float(np.ceil(20 * np.percentile(size, 90)) / 20), 0.5) if size.size else 0.5


def _values(
    verdict: Verdict, figures: dict[str, Any], rows: list[dict[str, Any]], folder: Path
) -> dict[str, Any]:
    """What the page shows."""
    limit = _limit(verdict)
    picture = colours(verdict.differences, (-limit, limit), COLOURS)
    texts = [{k: "" if v is None else str(v) for k, v in row.items()} for row in rows]
    return {
        "figures": figures,
        "links": [(name, name, "") for name in ("scores.json", "errors.csv", "edges.png")],
        "registration": _registration(figures["registration"]),
        "edges": figures["edges"],
        "table": table(texts),
        "shaded": encode(_shaded(verdict.model), MAP_BYTES),
        "map": encode(shrink(picture, MAP_PX), MAP_BYTES),
        "profile": encode_file(folder / "edges.png", FIGURE_BYTES, 620),
        "limit": limit,
        "gradient": gradient(COLOURS),
        "line": describe(figures),
    }


def _registration(found: dict[str, Any]) -> list[Headline]:
    """What is said of the model's place, with its standard uncertainty."""
    figures = (
        ("moved east", "east_m", "m"),
        ("moved north", "north_m", "m"),
        ("moved up", "up_m", "m"),
        ("tilt along east", "tilt_east_m_per_km", "m per km"),
        ("tilt along north", "tilt_north_m_per_km", "m per km"),
    )
    cards = []
    for title, name, unit in figures:
        sigma = found[f"sigma_{name}"]
        note = "" if sigma is None else f"± {sigma:.3f} {unit}"
        cards.append(Headline(title, minus(f"{found[name]:+.3f} {unit}"), note))
    return cards
