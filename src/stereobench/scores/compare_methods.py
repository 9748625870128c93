"""All methods of a dataset: tables, figure 10 and the page, from their scores and predictions.

Like a city's page, it needs no network and no other file; equal input gives equal bytes.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError, in_number
from stereotruth.core.products.files import read_table
from stereotruth.core.products.rasters import read_image
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
from stereotruth.tiles.stereo_dataset import StereoDataset

from . import panels
from .paired import differences
from .prediction_files import read_prediction
from .protocols import one_id
from .published import PUBLISHED
from .score_method import choose, describe
from .scores import ALL, Scorer
from .tables import (
    Figure,
    Table,
    by_city,
    by_strata,
    dataset_in_words,
    error_figures,
    of_figures,
    of_fine_tuned,
    of_methods,
)

log = logging.getLogger("stereotruth")

Row = Mapping[str, Any]
TEMPLATE = Path(__file__).with_name("page.html.jinja")
FIGURE_PX, FIGURE_BYTES = 2600, 3_000_000
PANEL_PX, PANELS_BYTES = 2000, 12_000_000  # the latter of all together
LAYER_PX, LAYERS_BYTES = 800, 4_000_000  # likewise, of the slider
THUMBNAIL_PX, THUMBNAIL_BYTES = 260, 12_000
COLUMNS = 6  # pairs of figure 10
SHOWN = (50, 68.27, 90, 95)  # percent, of the intervals of uncertainties
EXACT = ("exact_visible", "exact_hidden")
TIME = "time, s a pair"
NO_UNCERTAINTY = "No method states the uncertainty of its disparities."
HIDDEN = {  # strata that tell of hidden pixels, the first that there is
    "exact_hidden": "hidden: EPE, px",
    "near_occlusion": "near hidden: EPE, px",
    "match_outside": "match outside: EPE, px",
}


def compare(
    dataset: StereoDataset,
    split: str | None,
    scores: Sequence[str | Path],
    predictions: Sequence[str | Path],
    out: str | Path,
    *,
    index: str | Path | None = None,
) -> None:
    """Write tables, ``figure10.png`` and ``index.html`` to ``out``.

    ``scores``, ``predictions``: folders of the methods, in one order; ``index``: the page of all
    pages, for a link.

    Raises InputError if a method has no scores, or two have theirs by different protocols.
    """
    out = Path(out)
    methods = [_summary(Path(folder)) for folder in scores]
    tables = [table.by(one_id(methods)) for table in _tables(dataset, methods, scores)]
    for table in tables:
        table.write(out)
    scorer = Scorer(dataset.disparity_range)
    columns = []
    for pair in choose(dataset.pairs(split, labelled=True), COLUMNS):
        truth = dataset.labels(pair)
        found = {
            of["label"]: read_prediction(folder, pair) for of, folder in zip(methods, predictions)
        }
        columns.append(
            panels.Column(
                pair.name if pair.city in pair.name else f"{pair.city}, {pair.name}",
                read_image(pair.left),
                read_image(pair.right),
                np.where(scorer.counted(truth), truth, np.float32(np.nan)),
                found,
            )
        )
    panels.draw_columns(out / "figure10.png", columns)
    page = out / "index.html"
    write_page(page, TEMPLATE, _values(page, dataset.name, methods, tables, scores, columns, index))
    for line in tables[0].markdown().splitlines():
        if line.startswith("|"):
            log.info(line)


def _summary(folder: Path) -> dict[str, Any]:
    file = folder / "scores.json"
    if not file.is_file():
        raise InputError("no scores", file=file, remedy="run benchmark/<dataset>/<method>")
    return json.loads(file.read_text(encoding="utf-8"))


def _tables(
    dataset: StereoDataset, methods: Sequence[Row], scores: Sequence[str | Path]
) -> list[Table]:
    """All tables, those of the paper first."""
    trained = {pair.city for pair in dataset.pairs() if pair.split == "train"}
    beside_paper = dataset.layout != "us3d"  # the paper's figures are of these cities
    return [
        of_methods(methods, beside_paper=beside_paper),
        by_city(methods, trained, beside_paper=beside_paper),
        of_fine_tuned(methods, trained, beside_paper=beside_paper),
        by_strata(methods),
        differences(methods, [[folder] for folder in scores]),
        confidence_table(methods),
        beside_published(methods),
    ]


# -------------------------------------------------------------------------------------- the page


def _values(
    page: Path,
    dataset: str,
    methods: Sequence[Row],
    tables: Sequence[Table],
    scores: Sequence[str | Path],
    pairs: Sequence[panels.Column],
    index: str | Path | None,
) -> dict[str, Any]:
    """What the page shows; of the pairs the first is under a slider and in thumbnails of errors."""
    files = {
        of["label"]: sorted((Path(folder) / "panels").glob("*.png"))
        for of, folder in zip(methods, scores)
    }
    allowed = min(400_000, PANELS_BYTES // max(sum(map(len, files.values())), 1))
    pair = pairs[0] if pairs else None
    charts = (cumulative_chart(methods, scores), strata_chart(methods))
    return {
        "index": way(page, index),
        "dataset": dataset,
        "ranking": ranking(methods, pair),
        "methods": [(of["label"], describe(of), _settings(of)) for of in methods],
        "doubts": [f"{of['label']}: {doubt}" for of in methods for doubt in of["doubts"]],
        "links": [
            *((f"{t.name}.csv", f"{t.name}.csv", "") for t in tables),
            *((of["label"], str(way(page, folder)), "") for of, folder in zip(methods, scores)),
        ],
        "charts": [chart for chart in charts if chart],
        "curves": confidence_chart(methods, scores),
        "tables": [
            (t, [(text.replace("`", ""), shown) for text, shown in t.shown])
            for t in tables
            if any(shown and shown.groups for _, shown in t.shown)
        ],
        "protocol": one_id(methods),
        "seal": next((of["seal"] for of in methods), ""),
        "what": minus(dataset_in_words(methods)),
        "slider": _slider(pair),
        "errors": Scale.of(ERRORS, "0", f"{panels.ERROR_PX:g} px; blue: no disparity"),
        "figure": encode_file(page.with_name("figure10.png"), FIGURE_BYTES, FIGURE_PX),
        "panels": {
            label: [(file.stem, encode_file(file, allowed, PANEL_PX)) for file in of]
            for label, of in files.items()
            if of
        },
    }


def ranking(methods: Sequence[Row], pair: panels.Column | None) -> Shown:
    """The methods, the least error first, each figure with its interval.

    ``pair``: whose errors the thumbnails show. A method that returns a constant is named as such.
    """
    by_stratum = [{row["stratum"]: row for row in of["strata"]} for of in methods]
    hidden = next((name for name in HIDDEN if any(name in of for of in by_stratum)), "")
    epe, *limits = error_figures(methods)
    limits.sort(key=lambda figure: -float(figure.title.split()[1]))
    of_hidden = [Figure(HIDDEN[hidden], "hidden_epe_px")] if hidden else []
    figures = [
        replace(figure, interval=True)
        for figure in (epe, *limits, *of_hidden, Figure(TIME, "median_seconds", 1, ".2f"))
    ]
    ends = ("", "_low", "_high")
    rows = [
        {
            **of["all"],
            **{f"median_seconds{end}": of.get(f"median_seconds{end}") for end in ends},
            **{
                f"hidden_epe_px{end}": strata.get(hidden, {}).get(f"filled_epe_px{end}")
                for end in ends
            },
        }
        for of, strata in zip(methods, by_stratum)
    ]
    best = [figure.best(rows) for figure in figures]
    lines = []
    for of, row in zip(methods, rows):
        constant = of.get("constant_px")
        name = of["label"] if constant is None else f"{of['label']}\nconstant {constant:g} px"
        thumbnail = ()
        if pair is not None and of["label"] in pair.found:
            errors = panels.error_picture(pair.found[of["label"]], pair.truth)
            thumbnail = (encode(shrink(errors, THUMBNAIL_PX), THUMBNAIL_BYTES),)
        lines.append(
            (
                Cell(minus(name), of["label"]),
                Cell(f"errors of {of['label']}", "", href="#slider", pictures=thumbnail),
                *(figure.cell(row, b, line="\n") for figure, b in zip(figures, best)),
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
    limits = panels.disparity_limits([pair])
    shown = panels.pictures_of(pair, limits)
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
    values, epe = [], Figure("EPE, px", "filled_epe_px")
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
            text += f"{epe.text(row)} px"
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


# ------------------------------------------------------------------- others' figures, uncertainties


def beside_published(methods: Sequence[Row]) -> Table:
    """One's own scores of all labelled pixels, holes filled, and the published ones below."""
    title = "Published: scores of others beside these"
    name = methods[0]["protocol"]["name"] if methods else ""
    if name not in PUBLISHED:
        some = " and ".join(PUBLISHED)
        text = f"Nothing is published by a protocol like this one; some is by {some}."
        return Table("published", title, [], [(text, None)])
    rows = [
        {
            "method": of["label"],
            "epe_px": of["all"]["filled_epe_px"],
            "d1_percent": round(100 * of["all"]["filled_d1_3_px_share"], 4)
            if of["all"]["labelled"]
            else None,
            "source": f"here, {in_number(of['tiles'], 'pair')}",
            "not_known": "",
        }
        for of in methods
    ] + [vars(of) for of in PUBLISHED[name]]
    figures = [Figure("EPE (px)", "epe_px"), Figure("D1, 3 px (%)", "d1_percent", 1, ".2f")]
    more = {"source": "Source", "not_known": "Not known of its protocol"}
    caption = f"Only those scored here are known to be by protocol {methods[0]['protocol']['id']}."
    shown = of_figures(rows, {"method": "Method"}, figures, more)
    return Table("published", title, rows, [(caption, shown)])


def confidence_table(methods: Sequence[Row]) -> Table:
    """What the uncertainties of each method are worth, by stratum: see :mod:`.confidence`."""
    title = "Confidence: stated uncertainties held against the errors"
    every = [(of["label"], row) for of in methods for row in of["confidence"]]
    rows = [
        {"method": label, **row}
        for name in dict.fromkeys(row["stratum"] for _, row in every)
        for label, row in every
        if row["stratum"] == name and row["pixels"]
    ]
    if not rows:
        return Table("confidence", title, [], [(NO_UNCERTAINTY, None)])
    covered = [
        Figure(f"in {k:g} % interval (%)", f"interval_{k:g}_percent_coverage_share", 100, ".1f")
        for k in SHOWN
    ]
    figures = [
        Figure("EPE (px)", "epe_px"),
        Figure("AUSE (px)", "ause_px"),
        Figure("AUSE, share of random", "ause_share_of_random", 1, ".2f"),
        *covered,
        Figure("width of 90 % (px)", "interval_90_percent_mean_width_px", 1, ".2f"),
        Figure("factor of σ", "calibration_factor", 1, ".2f"),
    ]
    named = [
        {"name": f"{row['method']}, {row['stratum'].replace('_', ' ')}", **row} for row in rows
    ]
    caption = (
        "Valid pixels with an uncertainty. AUSE: area between the sparsification curve and an "
        "oracle's, 0 at best; share of random: of the AUSE of uncertainties in random order. "
        "Factor of σ: the uncertainties times this factor hold 68.27 % of the errors."
    )
    shown = of_figures(named, {"name": "Method, pixels"}, figures)
    return Table("confidence", title, rows, [(caption, shown)])


def read_curves(folder: str | Path) -> dict[str, NDArray[np.float64]]:
    """Curves [3, n] by stratum of a method's ``sparsification.csv``.

    Share of pixels taken away (%), the mean error of the rest, and the oracle's (px).
    """
    names = ("removed_share", "epe_px", "oracle_epe_px")
    found: dict[str, list[list[float]]] = {}
    for row in read_table(Path(folder) / "sparsification.csv"):
        found.setdefault(row["stratum"], []).append([float(row[name]) for name in names])
    return {name: np.array(of).T * [[100], [1], [1]] for name, of in found.items()}


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
