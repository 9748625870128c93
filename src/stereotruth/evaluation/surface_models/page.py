"""What a verdict over a surface model leaves: ``scores.json``, ``errors.csv``, ``index.html``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from ...products.files import whole_folder, write_json, write_table
from ...products.html_tables import minus, table
from ...products.pictures import colours, encode, encode_file, gradient, save_figure, shrink
from .edges import HIGH, LOW, SHARP, S
from .height_errors import OPEN
from .score import Verdict

MAP_BYTES, FIGURE_BYTES = 250_000, 60_000
COLOURS = "RdYlBu_r"


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


def write_verdict(verdict: Verdict, folder: str | Path, title: str) -> dict[str, Any]:
    """Write the folder, whole or not at all; returns what stands in ``scores.json``."""
    figures = verdict.figures()
    rows = [{"stratum": name, **of} for name, of in figures["errors"].items() if of["points"]]
    rows.append({"stratum": "as delivered, all but trees and water", **figures["as_delivered"]})
    with whole_folder(folder) as scratch:
        write_json(scratch / "scores.json", figures)
        write_table(scratch / "errors.csv", rows)
        _draw_profile(scratch / "edges.png", figures["edge_profile"])
        (scratch / "index.html").write_text(_page(verdict, figures, rows, title, scratch), "utf-8")
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


def _limit(verdict: Verdict) -> float:
    """Ends of the map's colours, m: what nine tenths of the differences keep, 0.5 at least."""
    size = np.abs(verdict.differences[np.isfinite(verdict.differences)])
    return max(float(np.ceil(20 * np.percentile(size, 90)) / 20), 0.5) if size.size else 0.5


def _page(
    verdict: Verdict, figures: dict[str, Any], rows: list[dict[str, Any]], title: str, folder: Path
) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("stereotruth.evaluation.surface_models", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    limit = _limit(verdict)
    picture = colours(verdict.differences, (-limit, limit), COLOURS)
    texts = [{k: "" if v is None else str(v) for k, v in row.items()} for row in rows]
    return environment.get_template("page.html.jinja").render(
        title=title,
        figures=figures,
        registration=_registration(figures["registration"]),
        edges=figures["edges"],
        table=table(texts),
        map=encode(shrink(picture, 700), MAP_BYTES),
        profile=encode_file(folder / "edges.png", FIGURE_BYTES, 620),
        limit=limit,
        gradient=gradient(COLOURS),
        line=describe(figures),
    )


def _registration(found: dict[str, Any]) -> list[tuple[str, str]]:
    """What is said of the model's place, and its value with its standard uncertainty."""

    def value(name: str, unit: str, digits: int) -> str:
        sigma = found[f"sigma_{name}"]
        text = f"{found[name]:+.{digits}f}"
        return minus(f"{text} {unit}" if sigma is None else f"{text} ± {sigma:.{digits}f} {unit}")

    return [
        ("moved east", value("east_m", "m", 3)),
        ("moved north", value("north_m", "m", 3)),
        ("moved up", value("up_m", "m", 3)),
        ("tilt along east", value("tilt_east_m_per_km", "m per km", 3)),
        ("tilt along north", value("tilt_north_m_per_km", "m per km", 3)),
    ]
