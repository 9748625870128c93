"""The methods of a dataset side by side: tables 5, 6 and 7 of the paper, and one by strata.

Made from the ``scores.json`` of each method. Figures are those of all labelled pixels, holes
filled, so that methods with and without holes compare; those of the valid pixels alone stand beside
them. CSV files hold all, with confidence intervals and the paper's figures (columns ``paper_…``: on
the real WHU-Stereo, by methods trained on it). Markdown files and the page hold what fits a page,
the best of its kind in bold: the least error, time and memory, and the largest share of valid
pixels, among the methods and where there are at least two. It stands with its 95 % interval where
there is one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stereotruth.core.errors import InputError, in_number
from stereotruth.core.products.files import atomic_file, write_table
from stereotruth.pages.tables import Cell, Column, metres, minus
from stereotruth.pages.tables import Table as Shown

from ..methods.kinds import KINDS
from . import published_scores
from .training_data import COLUMNS as TRAINING
from .training_data import training_data

Row = dict[str, Any]


PAPERS = "The paper's, on the real WHU-Stereo"
FILLED = "all labelled pixels, holes filled"
NOTHING = Cell("–", "")


@dataclass(frozen=True)
class Table:
    """Rows for a CSV file, and one or more tables with captions to read, in Markdown or on a page.

    Captions may have Markdown's marks of code.
    """

    name: str
    title: str
    rows: Sequence[Row]
    shown: Sequence[tuple[str, Shown]]
    also: str = ""  # what the paper calls it
    protocol: str = ""  # id of that by which the scores are made

    @property
    def columns(self) -> list[str]:
        """Of the CSV file, in order of appearance."""
        return list(dict.fromkeys(key for row in self.rows for key in row)) or ["method"]

    def by(self, protocol: str) -> Table:
        """The table with the id of the protocol that its scores are made by."""
        rows = [{"protocol": protocol, **row} for row in self.rows]
        return replace(self, rows=rows, protocol=protocol)

    def markdown(self) -> str:
        """What is to be read."""
        more = "".join(f" ({text})" for text in (self.also, self.protocol) if text)
        parts = [f"# {self.title}{more}"]
        for caption, shown in self.shown:
            lines = [
                [column.title for column in shown.columns],
                ["---:" if column.numeric else "---" for column in shown.columns],
            ]
            for heading, rows in shown.groups:
                if heading:
                    lines.append([f"**{heading}**", *[""] * (len(shown.columns) - 1)])
                lines += [[f"**{c.text}**" if c.best else c.text for c in row] for row in rows]
            parts.append(caption)
            parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
        return "\n\n".join(parts) + "\n"


@dataclass(frozen=True)
class Figure:
    """How a figure of the scores is shown: title, key, factor, format, whether more is better."""

    title: str
    key: str
    factor: float = 1
    form: str = ".3f"
    more: bool = False

    def cell(
        self, row: Row, best: float | None, *, interval: bool = False, line: str = " "
    ) -> Cell:
        """The figure of a row; ``best`` of all rows, which stands with its interval.

        ``line``: what stands between both.
        """
        value = row.get(self.key)
        if value is None:
            return NOTHING
        is_best = best is not None and value == best
        text = with_interval(row, self.key, self.factor, self.form, shown=interval or is_best)
        return Cell(minus(text.replace(" ", line, 1)), f"{value:.9g}", best=is_best)

    def best(self, rows: Sequence[Row]) -> float | None:
        """The best of at least two values."""
        values = [row[self.key] for row in rows if row.get(self.key) is not None]
        if len(values) < 2:
            return None
        return max(values) if self.more else min(values)


def plain_table(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> Shown:
    """A table of texts, sorted by the numbers that they begin with; words stand in the first."""
    numeric = [
        column > 0 and all(_leading(line[column]) is not None for line in lines)
        for column in range(len(heading))
    ]

    def cell(column: int, text: str) -> Cell:
        number = _leading(text)
        return Cell(minus(text) if column else text, text if number is None else number)

    rows = tuple(tuple(cell(k, text) for k, text in enumerate(line)) for line in lines)
    return Shown(tuple(map(Column, heading, numeric)), (("", rows),) if rows else ())


def nothing(name: str, title: str, why: str) -> Table:
    """A table without rows; ``why`` there are none."""
    return Table(name, title, [], [(why, plain_table(["Method"], []))])


def _leading(text: str) -> str | None:
    """The number that a text begins with; empty of a dash, None of words."""
    if text == "–":
        return ""
    begins = re.match(r"[+-]?\d+(\.\d+)?(?=$|\s)", text)
    return begins[0].lstrip("+") if begins else None


def read_scores(folders: Iterable[str | Path]) -> list[Row]:
    """The summaries of methods, from their folders. Raises InputError if one has none."""
    found = []
    for folder in folders:
        file = Path(folder) / "scores.json"
        if not file.is_file():
            raise InputError("no scores", file=file, remedy="run benchmark/<dataset>/<method>")
        found.append(json.loads(file.read_text(encoding="utf-8")))
    return found


def make_tables(
    methods: Sequence[Row], trained: Iterable[str], *, beside_paper: bool
) -> list[Table]:
    """Tables 5, 6, 7 and the one by strata.

    ``methods``: summaries of one dataset, in the order of the configuration; ``trained``: cities
    that have training tiles; ``beside_paper``: whether the paper's figures are of these cities.
    """
    trained = set(trained)
    return [
        of_methods(methods, beside_paper=beside_paper),
        by_city(methods, trained, beside_paper=beside_paper),
        of_fine_tuned(methods, trained, beside_paper=beside_paper),
        by_strata(methods),
    ]


def write_tables(tables: Iterable[Table], folder: str | Path) -> None:
    """``<name>.csv`` and ``<name>.md`` of each."""
    for table in tables:
        write_table(Path(folder) / f"{table.name}.csv", table.rows, table.columns)
        with atomic_file(Path(folder) / f"{table.name}.md") as scratch:
            scratch.write_text(table.markdown(), encoding="utf-8")


def of_methods(methods: Sequence[Row], *, beside_paper: bool) -> Table:
    """Accuracy, completeness, time and memory of the methods over all tiles."""
    rows = []
    for of in methods:
        row = {
            "method": of["label"],
            "kind": of["settings"]["kind"],
            **{key: value for key, value in of["all"].items() if key != "city"},
            "median_seconds": of["median_seconds"],
            "peak_memory_mb": of["peak_memory_mb"],
            "device": of["device"],
            "threads": of["threads"],
            **training_data(of),
        }
        published = published_scores.TABLE5.get(_kind(of)) if beside_paper else None
        if published and not of["fine_tuned_of"]:
            keys = ("paper_epe_px", "paper_d1_percent", "paper_ms")
            row |= dict(zip(keys, published))
        rows.append(row)
    caption = (
        f"Ours: {FILLED}, with 95 % confidence; then valid pixels only. {dataset_in_words(methods)}"
    )
    shown = [(caption, _accuracy(rows, methods))]
    if beside_paper:
        kinds = dict.fromkeys(_kind(of) for of in _plain(methods))
        shown += _published(
            ["Method", "EPE (px)", "D1 (%)", "Time (ms)"],
            [
                [
                    KINDS[kind].label,
                    *_paper(published_scores.TABLE5[kind][:2]),
                    f"{published_scores.TABLE5[kind][2]}",
                ]
                for kind in kinds
                if kind in published_scores.TABLE5
            ],
        )
    return Table("methods", "Accuracy, time and memory", rows, shown, "table 5 of the paper")


def _accuracy(rows: Sequence[Row], methods: Sequence[Row]) -> Shown:
    """A row per method."""
    limits = methods[0]["thresholds_px"] if methods else [3.0]
    first = limits[0]
    figures = [
        Figure("EPE, px", "filled_epe_px"),
        *(
            Figure(f"> {limit:g} px, %", f"filled_d1_{limit:g}_px_share", 100, ".2f")
            for limit in limits
        ),
        Figure("valid only: median, px", "median_px"),
        Figure("valid only: EPE, px", "epe_px"),
        Figure(f"valid only: > {first:g} px, %", f"d1_{first:g}_px_share", 100, ".2f"),
        Figure("valid, %", "valid_share", 100, ".2f", more=True),
        Figure("time, ms a pair", "median_seconds", 1000, ".0f"),
        Figure("memory, MB", "peak_memory_mb", 1, ".0f"),
    ]
    best = [figure.best(rows) for figure in figures]
    heights = [of.get("height_m_per_px") for of in methods]
    lines = []
    for row, height in zip(rows, heights):
        cells = [
            figure.cell(row, b, interval=k < 2) for k, (figure, b) in enumerate(zip(figures, best))
        ]
        epe = row.get("filled_epe_px")
        if any(heights):
            known = epe is not None and height is not None
            text = metres(epe, height).removesuffix(" m of height") if known else "–"
            cells.insert(1, Cell(text, f"{epe * height:.9g}" if known else "", best=cells[0].best))
        cells += [Cell(row[key], row[key]) for key in TRAINING]
        lines.append((Cell(row["method"], row["method"]), *cells))
    titles = [figure.title for figure in figures]
    if any(heights):
        titles.insert(1, "EPE, m of height")
    columns = (
        Column("method", False),
        *(Column(title, True) for title in titles),
        *(Column(title, False) for title in TRAINING.values()),
    )
    return Shown(columns, (("", tuple(lines)),))


def _by_method(rows: Sequence[Row], name: str, methods: Sequence[Row]) -> Shown:
    """A row per city or stratum, columns for each method; a group's own row stands last in it."""
    labels = [of["label"] for of in methods]
    figures = [Figure("EPE, px", "filled_epe_px")]
    if methods:
        limit = methods[0]["thresholds_px"][0]
        figures.append(Figure(f"> {limit:g} px, %", f"filled_d1_{limit:g}_px_share", 100, ".2f"))
    groups = list(dict.fromkeys(row.get("group", "") for row in rows))
    found = []
    for group in groups:
        here = [row for row in rows if row.get("group", "") == group]
        lines = []
        for value in dict.fromkeys(row[name] for row in here):
            by_method = {row["method"]: row for row in here if row[name] == value}
            best = [figure.best(list(by_method.values())) for figure in figures]
            cells = [
                figure.cell(by_method.get(method, {}), b)
                for method in labels
                for figure, b in zip(figures, best)
            ]
            text = value.replace("_", " ")
            lines.append((Cell(text, text), *cells))
        found.append((group, tuple(lines)))
    titles = [f"{method}: {figure.title}" for method in labels for figure in figures]
    first = "pixels" if name == "stratum" else name
    columns = (Column(first, False), *(Column(title, True) for title in titles))
    return Shown(columns, tuple(found))


def by_city(methods: Sequence[Row], trained: set[str], *, beside_paper: bool) -> Table:
    """Scores by city: generalisation within cities, extrapolation to others."""
    table = Table("by_city", "Accuracy by city", [], [], "table 6 of the paper")
    return _by_city(table, _plain(methods), trained, beside_paper=beside_paper)


def of_fine_tuned(methods: Sequence[Row], trained: set[str], *, beside_paper: bool) -> Table:
    """Fine-tuned methods by city, beside the same methods trained on this dataset alone."""
    table = Table("fine_tuned", "Fine-tuned methods by city", [], [], "table 7 of the paper")
    by_name = {of["method"]: of for of in methods}
    columns: list[Row] = []
    for of in methods:
        base = of["fine_tuned_of"]
        if base is not None:
            if base in by_name and by_name[base] not in columns:
                columns.append(by_name[base])
            columns.append(of)
    if not columns:
        text = "No method of the configuration has `fine_tuned_of`."
        return nothing(table.name, table.title, text)
    return _by_city(table, columns, trained, beside_paper=beside_paper)


def by_strata(methods: Sequence[Row]) -> Table:
    """Where the methods differ."""
    names = list(dict.fromkeys(row["stratum"] for of in methods for row in of["strata"]))
    found = {of["method"]: {row["stratum"]: row for row in of["strata"]} for of in methods}
    rows = [
        {"method": of["label"], **found[of["method"]][name]}
        for name in names
        for of in methods
        if name in found[of["method"]]
    ]
    caption = f"EPE and D1 ({FILLED}) by what the pixels show"
    shown = [(caption, _by_method(rows, "stratum", methods))]
    return Table("strata", "Scores by what the pixels show", rows, shown)


def _by_city(
    table: Table, methods: Sequence[Row], trained: set[str], *, beside_paper: bool
) -> Table:
    """The table with the methods' scores by city, cities with training tiles first."""
    cities = list(dict.fromkeys(row["city"] for of in methods for row in of["cities"]))
    groups = [
        ("cities with training tiles", [city for city in cities if city in trained]),
        ("cities without", [city for city in cities if city not in trained]),
    ]
    rows = []
    for group, members in groups:
        for city in members:
            for of in methods:
                row = {"city": city, "group": group, "method": of["label"], **_city(of, city)}
                if beside_paper and (values := _published_of(of, city)):
                    row |= dict(zip(("paper_epe_px", "paper_d1_percent"), values))
                rows.append(row)
        if len(members) > 1:
            pooled = [_pooled(of, members) for of in methods]
            rows += [
                {"city": "all of group", "group": group, "method": of["label"], **row}
                for of, row in zip(methods, pooled)
            ]
    caption = f"Ours: EPE and D1 of {FILLED}. {dataset_in_words(methods)}"
    shown = [(caption, _by_method(rows, "city", methods))]
    if beside_paper:
        there: dict[tuple[str, bool], Row] = {}  # several methods here may be of one there
        for of in methods:
            there.setdefault((_kind(of), bool(of["fine_tuned_of"])), of)
        known = []
        for city in cities:
            values = [_published_of(of, city) for of in there.values()]
            if any(values):
                known.append([city, *(text for of in values for text in _paper(of))])
        shown += _published(_heading("City", list(there.values())), known)
    return replace(table, rows=rows, shown=shown)


def _published_of(of: Row, city: str) -> tuple[float, float] | None:
    """The paper's EPE and D1 of a kind of method in a city: table 7 of fine-tuned ones, else 6."""
    table = published_scores.TABLE7 if of["fine_tuned_of"] else published_scores.TABLE6
    return table.get(city, {}).get(_kind(of))


def _published(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> list[tuple[str, Shown]]:
    return [(f"{PAPERS}.", plain_table(heading, lines))] if lines else []


def _paper(values: Sequence[float] | None) -> tuple[str, str]:
    """EPE and D1 as the paper prints them."""
    return ("–", "–") if values is None else (f"{values[0]:.3f}", f"{values[1]:.2f}")


def _heading(first: str, methods: Sequence[Row]) -> list[str]:
    pairs = ((f"{of['label']}: EPE (px)", "D1 (%)") for of in methods)
    return [first, *(name for pair in pairs for name in pair)]


def _plain(methods: Sequence[Row]) -> list[Row]:
    """The methods that are not fine-tuned."""
    return [of for of in methods if not of["fine_tuned_of"]]


def _kind(of: Row) -> str:
    return of["settings"]["kind"]


def _city(of: Row, city: str) -> Row:
    found = (row for row in of["cities"] if row["city"] == city)
    return {key: value for key, value in next(found, {}).items() if key != "city"}


def _pooled(of: Row, cities: Sequence[str]) -> Row:
    """Figures of all labelled pixels of some cities, of those of each."""
    rows = [row for row in of["cities"] if row["city"] in cities]
    labelled = sum(row["labelled"] for row in rows)
    keys = ["filled_epe_px", *(f"filled_d1_{limit:g}_px_share" for limit in of["thresholds_px"])]
    found: Row = {"tiles": sum(row["tiles"] for row in rows), "labelled": labelled}
    for key in keys:
        total = sum(row["labelled"] * row[key] for row in rows if row["labelled"])
        found[key] = round(total / labelled, 6) if labelled else None
    return found


def with_interval(row: Row, key: str, factor: float, form: str, *, shown: bool = True) -> str:
    """A figure and, where there is one and it is to be shown, its interval."""
    text = _number(row.get(key), factor, form)
    ends = [row.get(f"{key}_{end}") for end in ("low", "high")]
    if shown and None not in ends:
        text += f" [{', '.join(_number(end, factor, form) for end in ends)}]"
    return text


def _number(value: float | None, factor: float, form: str) -> str:
    return "–" if value is None else format(factor * value, form)


def dataset_in_words(methods: Sequence[Row]) -> str:
    """Dataset, split, pairs and range."""
    if not methods:
        return ""
    of = methods[0]
    low, high = of["disparity_range"]
    split = f"split {of['split']}" if of["split"] else "all splits"
    exact = of.get("protocol", {}).get("truth") == "exact"
    more = " Labelled: by the exact truth, all that both views see." if exact else ""
    where = (
        f"Dataset {of['dataset']}, {split}, {in_number(of['tiles'], 'pair')}, "
        f"disparities [{low}, {high}) px."
    )
    return where + more
