"""The page of a benchmark: the best methods, charts, tables, figure 10 and pictures of tiles.

Like a city's page, it needs no network and no other file; equal input gives equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...pages.page import way, write_page
from ...pages.pictures import DISPARITIES, ERRORS, encode, encode_file, gradient, shrink
from ...pages.tables import Headline, metres, minus
from .page_charts import cumulative_chart, strata_chart
from .page_tables import sections
from .panels import ERROR_PX, Column, map_pictures
from .protocols import one_id
from .score_method import describe
from .tables import Table, with_interval

Row = Mapping[str, Any]
TEMPLATE = Path(__file__).with_name("page.html.jinja")
FIGURE_PX, FIGURE_BYTES = 2600, 3_000_000
PANEL_PX, PANELS_BYTES = 2000, 12_000_000  # the latter of all together
SWIPE_PX, SWIPE_BYTES = 800, 4_000_000  # likewise


def write_benchmark(
    out: str | Path,
    dataset: str,
    methods: Sequence[Row],
    tables: Sequence[Table],
    scores: Sequence[str | Path],
    figure: str | Path | None,
    curves: str | Path | None = None,
    *,
    pairs: Sequence[Column] = (),
    index: str | Path | None = None,
) -> None:
    """Write the page of a dataset.

    ``methods``: their summaries; ``scores``: their folders, with pictures of tiles; ``figure``:
    figure 10; ``curves``: the sparsification curves; ``pairs``: those of which two methods can be
    swiped over each other, the first one with truth is taken; ``index``: the page of all pages.
    """
    panels = {
        of["label"]: sorted((Path(folder) / "panels").glob("*.png"))
        for of, folder in zip(methods, scores)
    }
    panels = {label: files for label, files in panels.items() if files}
    allowed = min(400_000, PANELS_BYTES // max(sum(map(len, panels.values())), 1))
    charts = (cumulative_chart(methods, scores), strata_chart(methods))
    values = {
        "index": way(out, index),
        "dataset": dataset,
        "headlines": headlines(methods, tables),
        "methods": [(of["label"], describe(of), _settings(of)) for of in methods],
        "doubts": [f"{of['label']}: {doubt}" for of in methods for doubt in of["doubts"]],
        "links": [
            *((f"{t.name}.csv", f"{t.name}.csv", "") for t in tables),
            *((of["label"], str(way(out, folder)), "") for of, folder in zip(methods, scores)),
        ],
        "charts": [chart for chart in charts if chart],
        "sections": sections(tables, one_id(methods)),
        "protocol": one_id(methods),
        "swipe": _swipe(pairs),
        "figure": None if figure is None else encode_file(Path(figure), FIGURE_BYTES, FIGURE_PX),
        "curves": None if curves is None else encode_file(Path(curves), FIGURE_BYTES, FIGURE_PX),
        "panels": {
            label: [(file.stem, encode_file(file, allowed, PANEL_PX)) for file in files]
            for label, files in panels.items()
        },
    }
    write_page(out, TEMPLATE, values)


def _swipe(pairs: Sequence[Column]) -> dict[str, Any] | None:
    """Left image, truth, disparities and errors of the first pair with truth, to be swiped."""
    pair = next((of for of in pairs if of.truth is not None), None)
    if pair is None:
        return None
    limits, shown = map_pictures(pair)
    allowed = min(200_000, SWIPE_BYTES // len(shown))
    names = [name for name in shown if name not in ("left", "right")]
    return {
        "title": pair.title,
        "pictures": {of: encode(shrink(shown[of], SWIPE_PX), allowed) for of in ("left", *names)},
        "first": names[-2:] if len(pair.found) > 1 else ["left", names[-1]],
        "limits": limits,
        "disparities": gradient(DISPARITIES),
        "error_px": ERROR_PX,
        "errors": gradient(ERRORS),
    }


def headlines(methods: Sequence[Row], tables: Sequence[Table]) -> list[Headline]:
    """The best of each figure, by how much it is better than the next, and of how many pairs."""
    first = methods[0]
    limit = first["thresholds_px"][0]
    found = []
    ranked = sorted(
        (of for of in methods if of["all"]["filled_epe_px"] is not None),
        key=lambda of: of["all"]["filled_epe_px"],
    )
    if ranked:
        of = ranked[0]
        height = metres(of["all"]["filled_epe_px"], of.get("height_m_per_px"))
        found.append(_card("least EPE", of, "filled_epe_px", 1, ".3f", " px", height))
        d1 = f"filled_d1_{limit:g}_px_share"
        least = min(ranked, key=lambda of: of["all"][d1])
        found.append(_card(f"least D1, {limit:g} px", least, d1, 100, ".2f", " %"))
    if len(ranked) > 1:
        names = [of["label"] for of in ranked[:2]]
        rows = next((t.rows for t in tables if t.name == "differences"), ())
        row = next((row for row in rows if {row["method"], row["less"]} == set(names)), None)
        if row and row["epe_px"] is not None:
            ends = [row["epe_px"], row.get("epe_px_low"), row.get("epe_px_high")]
            if row["method"] == names[0]:  # the best less the next: turned around
                ends = [None if v is None else -v for v in (ends[0], ends[2], ends[1])]
            value, low, high = ends
            note = f"more EPE than {names[0]} on the same tiles"
            if low is not None and high is not None:
                note += f", 95 %: {low:+.3f} to {high:+.3f}"
                note += "; no clear difference" if low <= 0 <= high else ""
            found.append(Headline(f"next: {names[1]}", f"{value:+.3f} px", minus(note)))
    timed = [of for of in methods if of["median_seconds"] is not None]
    if timed:
        of = min(timed, key=lambda of: of["median_seconds"])
        seconds = of["median_seconds"]
        text = f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.0f} s"
        found.append(Headline("least time a pair", text, _and(of["label"], of["device"])))
    split = f"split {first['split']}" if first["split"] else "all splits"
    low, high = first["disparity_range"]
    pixels = first["all"]["labelled"] / 1e6
    note = f"{split}; {pixels:.1f} million labels in [{low}, {high}) px"
    found.append(Headline("pairs", str(first["tiles"]), minus(note)))
    found.append(Headline("methods", str(len(methods)), ", ".join(of["label"] for of in methods)))
    return found


def _card(
    title: str, of: Row, key: str, factor: float, form: str, unit: str, more: str = ""
) -> Headline:
    """The figure of a method, its interval in the remark."""
    value = f"{factor * of['all'][key]:{form}}{unit}"
    row = dict(of["all"])
    interval = with_interval(row, key, factor, form).partition(" ")[2]
    return Headline(title, value, _and(of["label"], interval and f"95 % {interval}", more))


def _and(*parts: str | None) -> str:
    return "; ".join(part for part in parts if part)


def _settings(of: Row) -> str:
    settings = ", ".join(f"{key} {value}" for key, value in of["settings"].items())
    machine = f"; {of['device']}, {of['threads']} threads" if of["device"] else ""
    return f"{settings}{machine}"
