"""The page of a benchmark: the ranked methods, charts, tables, figure 10 and pictures of tiles.

Like a city's page, it needs no network and no other file; equal input gives equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereotruth.core.products.files import read_table
from stereotruth.pages.figures import Chart, Plot, log_axis, look, styled
from stereotruth.pages.page import way, write_page
from stereotruth.pages.pictures import (
    DISPARITIES,
    ERRORS,
    Layer,
    Scale,
    encode,
    encode_file,
    shrink,
)
from stereotruth.pages.tables import Cell, Column, metres, minus
from stereotruth.pages.tables import Table as Shown

from . import panels
from .confidence_table import confidence_chart
from .protocols import one_id
from .score_method import describe
from .tables import Figure, Table, dataset_in_words, with_interval

Row = Mapping[str, Any]
TEMPLATE = Path(__file__).with_name("page.html.jinja")
FIGURE_PX, FIGURE_BYTES = 2600, 3_000_000
PANEL_PX, PANELS_BYTES = 2000, 12_000_000  # the latter of all together
LAYER_PX, LAYERS_BYTES = 800, 4_000_000  # likewise, of the slider
THUMBNAIL_PX, THUMBNAIL_BYTES = 260, 12_000
HIDDEN = {  # strata that tell of hidden pixels, the first that there is
    "exact_hidden": "hidden: EPE, px",
    "near_occlusion": "near hidden: EPE, px",
    "match_outside": "match outside: EPE, px",
}


def write_benchmark(
    out: str | Path,
    dataset: str,
    methods: Sequence[Row],
    tables: Sequence[Table],
    scores: Sequence[str | Path],
    figure: str | Path | None,
    *,
    pairs: Sequence[panels.Column] = (),
    index: str | Path | None = None,
) -> None:
    """Write the page of a dataset.

    ``methods``: their summaries; ``scores``: their folders, with pictures of tiles; ``figure``:
    figure 10; ``pairs``: the first one with truth is shown under a slider and as thumbnails of
    errors; ``index``: the page of all pages.
    """
    files = {
        of["label"]: sorted((Path(folder) / "panels").glob("*.png"))
        for of, folder in zip(methods, scores)
    }
    allowed = min(400_000, PANELS_BYTES // max(sum(map(len, files.values())), 1))
    pair = next((of for of in pairs if of.truth is not None), None)
    charts = (cumulative_chart(methods, scores), strata_chart(methods))
    values = {
        "index": way(out, index),
        "dataset": dataset,
        "ranking": ranking(methods, pair),
        "methods": [(of["label"], describe(of), _settings(of)) for of in methods],
        "doubts": [f"{of['label']}: {doubt}" for of in methods for doubt in of["doubts"]],
        "links": [
            *((f"{t.name}.csv", f"{t.name}.csv", "") for t in tables),
            *((of["label"], str(way(out, folder)), "") for of, folder in zip(methods, scores)),
        ],
        "charts": [chart for chart in charts if chart],
        "curves": confidence_chart(methods, scores),
        "tables": [
            (
                t,
                [(text.replace("`", ""), shown if shown.groups else None)
                 for text, shown in t.shown],
            )
            for t in tables
            if any(shown.groups for _, shown in t.shown)
        ],
        "protocol": one_id(methods),
        "what": minus(dataset_in_words(methods)),
        "slider": _slider(pair),
        "errors": Scale.of(ERRORS, "0", f"{panels.ERROR_PX:g} px; blue: no disparity"),
        "figure": None if figure is None else encode_file(Path(figure), FIGURE_BYTES, FIGURE_PX),
        "panels": {
            label: [(file.stem, encode_file(file, allowed, PANEL_PX)) for file in of]
            for label, of in files.items()
            if of
        },
    }  # fmt: skip
    write_page(out, TEMPLATE, values)


def ranking(methods: Sequence[Row], pair: panels.Column | None) -> Shown:
    """The methods, the least error first, each figure with its interval.

    ``pair``: whose errors the thumbnails show. A method that returns a constant is named as such.
    """
    by_stratum = [{row["stratum"]: row for row in of["strata"]} for of in methods]
    hidden = next((name for name in HIDDEN if any(name in of for of in by_stratum)), "")
    limits = sorted(methods[0]["thresholds_px"], reverse=True)
    figures = [
        Figure("EPE, px", "filled_epe_px"),
        *(Figure(f"> {v:g} px, %", f"filled_d1_{v:g}_px_share", 100, ".2f") for v in limits),
        *([Figure(HIDDEN[hidden], "hidden_epe_px")] if hidden else []),
        Figure("time, s a pair", "median_seconds", 1, ".2f"),
    ]
    rows = []
    for of, strata in zip(methods, by_stratum):
        row = dict(of["all"])
        for name in ("median_seconds", "median_seconds_low", "median_seconds_high"):
            row[name] = of.get(name)
        for end in ("", "_low", "_high"):
            row[f"hidden_epe_px{end}"] = strata.get(hidden, {}).get(f"filled_epe_px{end}")
        rows.append(row)
    best = [figure.best(rows) for figure in figures]
    lines = []
    for of, row in zip(methods, rows):
        constant = of.get("constant_px")
        name = of["label"] if constant is None else f"{of['label']}\nconstant {constant:g} px"
        look_of = ()
        if pair is not None and pair.truth is not None and of["label"] in pair.found:
            errors = panels.error_picture(pair.found[of["label"]], pair.truth)
            look_of = (encode(shrink(errors, THUMBNAIL_PX), THUMBNAIL_BYTES),)
        lines.append(
            (
                Cell(minus(name), of["label"]),
                Cell(f"errors of {of['label']}", "", href="#slider", pictures=look_of),
                *(
                    figure.cell(row, b, interval=True, line="\n")
                    for figure, b in zip(figures, best)
                ),
            )
        )
    lines.sort(key=lambda line: float(line[2].key or "inf"))
    titles = ("method", "errors", *(figure.title for figure in figures))
    columns = tuple(Column(title, k > 1) for k, title in enumerate(titles))
    return Shown(columns, (("", tuple(lines)),))


def _slider(pair: panels.Column | None) -> dict[str, Any] | None:
    """Left image, truth, disparities and errors of a pair, to be laid over each other."""
    if pair is None:
        return None
    limits, shown = panels.map_pictures(pair)
    allowed = min(200_000, LAYERS_BYTES // len(shown))
    names = [name for name in shown if name not in ("left", "right")]
    disparity = Scale.of(DISPARITIES, *(minus(f"{value:.0f} px") for value in limits))
    error = Scale.of(ERRORS, "0", f"{panels.ERROR_PX:g} px; blue: no disparity")
    layers = {"left image": Layer(encode(shrink(shown["left"], LAYER_PX), allowed))}
    for name in names:
        uri = encode(shrink(shown[name], LAYER_PX), allowed)
        layers[name] = Layer(uri, error if name.startswith("error of ") else disparity)
    first = names[-2:] if len(pair.found) > 1 else ["left image", names[-1]]
    return {"title": pair.title, "layers": layers, "first": first}


@styled
def cumulative_chart(methods: Sequence[Row], folders: Sequence[str | Path]) -> Chart:
    """Share of the pixels whose error is not above a limit, over the limit, for each method.

    ``folders``: of the scores, with ``cumulative.csv``, in the order of the methods.
    """
    plot = Plot.of(
        "pixels below an error",
        "All labelled pixels, holes filled. The higher the better.",
        (6.4, 4.2),
    )
    values = []
    for number, (of, folder) in enumerate(zip(methods, folders)):
        rows = list(read_table(Path(folder) / "cumulative.csv"))
        points = [(float(row["error_px"]), 100 * float(row["share"])) for row in rows]
        style = look(number) | {"marker": "none"}
        (line,) = plot.axis.plot(*zip(*points), label=of["label"], linewidth=2, **style)
        plot.hover(line, [of["label"]])
        values += [{"method": of["label"], **row} for row in rows]
    plot.axis.set_xscale("log")
    log_axis(plot.axis.xaxis)
    plot.axis.set(xlabel="absolute error, px", ylabel="% of the pixels below", ylim=(0, 102))
    plot.figure.legend(loc="outside lower center", ncols=3)
    return plot.chart(values)


@styled
def strata_chart(methods: Sequence[Row]) -> Chart | None:
    """EPE by what the pixels show, with 95 % intervals; None of no strata."""
    names = list(dict.fromkeys(row["stratum"] for of in methods for row in of["strata"]))
    if not any(row["filled_epe_px"] for of in methods for row in of["strata"]):
        return None
    plot = Plot.of(
        "errors by what the pixels show",
        "EPE of all labelled pixels, holes filled, with 95 % intervals by resampling tiles. "
        "Further left is better.",
        (6.4, 1.1 + (0.2 + 0.09 * len(methods)) * len(names)),
    )
    values = []
    for number, of in enumerate(methods):
        style = look(number) | {"linestyle": "none"}
        offset = 0.6 * ((number + 0.5) / len(methods) - 0.5)
        rows = [row for row in of["strata"] if row["filled_epe_px"]]
        at = [names.index(row["stratum"]) + offset for row in rows]
        (marks,) = plot.axis.plot(
            [row["filled_epe_px"] for row in rows], at, label=of["label"], markersize=5, **style
        )
        texts = []
        for row, y in zip(rows, at):
            ends = [row.get(f"filled_epe_px_{end}") for end in ("low", "high")]
            if None not in ends:
                plot.axis.plot(ends, [y, y], color=style["color"], linewidth=1.4)
            text = f"{of['label']}, {row['stratum'].replace('_', ' ')}: "
            text += f"{with_interval(row, 'filled_epe_px', 1, '.3f')} px"
            height = metres(row["filled_epe_px"], of.get("height_m_per_px"))
            texts.append(f"{text}, {height}" if height else text)
            values.append({"method": of["label"], **row})
        plot.hover(marks, texts)
    plot.axis.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    plot.axis.set_ylim(len(names) - 0.5, -0.5)
    plot.axis.set_xscale("log")
    log_axis(plot.axis.xaxis)
    plot.axis.set_xlabel("EPE, px")
    plot.figure.legend(loc="outside lower center", ncols=3)
    keys = list(dict.fromkeys(key for row in values for key in row))
    return plot.chart([{key: row.get(key) for key in keys} for row in values])


def _settings(of: Row) -> str:
    settings = ", ".join(f"{key} {value}" for key, value in of["settings"].items())
    machine = f"; {of['device']}, {of['threads']} threads" if of["device"] else ""
    return f"{settings}{machine}"
