"""The methods of a dataset side by side: tables 5, 6 and 7 of the paper, and others beside them.

Made from the ``scores.json`` of each method. Figures are those of all labelled pixels, holes
filled, so that methods with and without holes compare; those of the valid pixels alone stand beside
them. CSV files hold all, with confidence intervals and the paper's figures (columns ``paper_…``: on
the real WHU-Stereo, by methods trained on it). Markdown files and the page hold what fits a page,
the best of its kind in bold: the least error, time and memory, and the largest share of valid
pixels, among the methods and where there are at least two. It stands with its 95 % interval where
there is one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stereotruth.core.errors import in_number
from stereotruth.core.products.files import atomic_file, write_table
from stereotruth.pages.tables import EMPTY, Cell, Column, metres, minus
from stereotruth.pages.tables import Table as Shown

from ..methods.kinds import KINDS
from .published import TABLE5, TABLE6, TABLE7, training_data
from .published import TRAINING_COLUMNS as TRAINING

Row = Mapping[str, Any]


PAPERS = "The paper's, on the real WHU-Stereo."
FILLED = "all labelled pixels, holes filled"


@dataclass(frozen=True)
class Table:
    """Rows for a CSV file, and one or more tables with captions to read, in Markdown or on a page.

    Captions may have Markdown's marks of code. No table is shown (None) of no rows.
    """

    name: str
    title: str
    rows: Sequence[Row]
    shown: Sequence[tuple[str, Shown | None]]
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
            parts.append(caption)
            if shown is None:
                continue
            lines = [
                [column.title for column in shown.columns],
                ["---:" if column.numeric else "---" for column in shown.columns],
            ]
            for heading, rows in shown.groups:
                if heading:
                    lines.append([f"**{heading}**", *[""] * (len(shown.columns) - 1)])
                lines += [[f"**{c.text}**" if c.best else c.text for c in row] for row in rows]
            parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
        return "\n\n".join(parts) + "\n"

    def write(self, folder: str | Path) -> None:
        """Write ``<name>.csv`` and ``<name>.md``."""
        write_table(Path(folder) / f"{self.name}.csv", self.rows, self.columns)
        with atomic_file(Path(folder) / f"{self.name}.md") as scratch:
            scratch.write_text(self.markdown(), encoding="utf-8")


@dataclass(frozen=True)
class Figure:
    """How a figure of the scores is shown: title, key, factor, format, whether more is better.

    ``interval``: whether it stands with its interval even where it is not the best.
    """

    title: str
    key: str
    factor: float = 1
    form: str = ".3f"
    more: bool = False
    interval: bool = False

    def text(self, row: Row, *, interval: bool = True, line: str = " ") -> str:
        """The figure of a row and, if wanted and known, its interval after ``line``."""
        text = format(self.factor * row[self.key], self.form)
        ends = [row.get(f"{self.key}_{end}") for end in ("low", "high")]
        if interval and None not in ends:
            text += f"{line}[{', '.join(format(self.factor * v, self.form) for v in ends)}]"
        return text

    def cell(self, row: Row, best: float | None = None, line: str = " ") -> Cell:
        """The figure of a row; ``best`` of all rows, which is bold and has its interval."""
        value = row.get(self.key)
        if value is None:
            return EMPTY
        is_best = best is not None and value == best
        text = self.text(row, interval=self.interval or is_best, line=line)
        return Cell(minus(text), f"{value:.9g}", best=is_best)

    def best(self, rows: Sequence[Row]) -> float | None:
        """The best of at least two values."""
        values = [row[self.key] for row in rows if row.get(self.key) is not None]
        if len(values) < 2:
            return None
        return max(values) if self.more else min(values)


def of_figures(
    rows: Sequence[Row],
    names: Mapping[str, str],
    figures: Sequence[Figure],
    more: Mapping[str, str] | None = None,
) -> Shown | None:
    """A table of rows: ``names`` in words, figures of which none is bold, ``more`` words.

    The words by the key in a row and the title of their column. None of no rows.
    """
    words = [tuple(Cell(row[key], row[key]) for key in names) for row in rows]
    after = [tuple(Cell(row[key], row[key]) for key in more or ()) for row in rows]
    lines = [
        (*first, *(figure.cell(row) for figure in figures), *last)
        for row, first, last in zip(rows, words, after)
    ]
    titles = [*names.values(), *(figure.title for figure in figures), *(more or {}).values()]
    is_text = [k for k in range(len(titles)) if not 0 <= k - len(names) < len(figures)]
    return Shown.of(titles, lines, is_text)


# ------------------------------------------------------------------- tables 5, 6, 7 and by strata


def of_methods(methods: Sequence[Row], *, beside_paper: bool) -> Table:
    """Accuracy, completeness, time and memory of the methods over all tiles: table 5.

    ``methods``: summaries of one dataset, in the order of the configuration, here as in the other
    tables; ``beside_paper``: whether the paper's figures are of these cities.
    """
    rows = []
    for of in methods:
        row = {
            "method": of["label"],
            "kind": of["settings"]["kind"],
            **{key: value for key, value in of["all"].items() if key != "city"},
            **{key: of[key] for key in ("median_seconds", "peak_memory_mb", "device", "threads")},
            **training_data(of),
        }
        published = TABLE5.get(_kind(of)) if beside_paper else None
        if published and not of["fine_tuned_of"]:
            row |= dict(zip(("paper_epe_px", "paper_d1_percent", "paper_ms"), published))
        rows.append(row)
    caption = (
        f"Ours: {FILLED}, with 95 % confidence; then valid pixels only. {dataset_in_words(methods)}"
    )
    shown = [(caption, _accuracy(rows, methods))]
    kinds = dict.fromkeys(_kind(of) for of in methods if not of["fine_tuned_of"])
    figures = [
        Figure("EPE (px)", "0"),
        Figure("D1 (%)", "1", 1, ".2f"),
        Figure("Time (ms)", "2", 1, ".0f"),
    ]
    theirs = [
        {"method": KINDS[kind].label, **{str(k): v for k, v in enumerate(TABLE5[kind])}}
        for kind in kinds
        if kind in TABLE5
    ]
    if beside_paper and theirs:
        shown.append((PAPERS, of_figures(theirs, {"method": "Method"}, figures)))
    return Table("methods", "Accuracy, time and memory", rows, shown, "table 5 of the paper")


def error_figures(methods: Sequence[Row]) -> list[Figure]:
    """EPE, and D1 at each threshold."""
    limits = methods[0]["thresholds_px"] if methods else [3.0]
    return [
        Figure("EPE, px", "filled_epe_px"),
        *(Figure(f"> {v:g} px, %", f"filled_d1_{v:g}_px_share", 100, ".2f") for v in limits),
    ]


def _accuracy(rows: Sequence[Row], methods: Sequence[Row]) -> Shown:
    """A row per method."""
    errors = error_figures(methods)
    first = methods[0]["thresholds_px"][0] if methods else 3.0
    figures = [
        *(replace(figure, interval=True) for figure in errors[:2]),
        *errors[2:],
        Figure("valid only: median, px", "median_px"),
        Figure("valid only: EPE, px", "epe_px"),
        Figure(f"valid only: > {first:g} px, %", f"d1_{first:g}_px_share", 100, ".2f"),
        Figure("valid, %", "valid_share", 100, ".2f", more=True),
        Figure("time, ms a pair", "median_seconds", 1000, ".0f"),
        Figure("memory, MB", "peak_memory_mb", 1, ".0f"),
    ]
    best = [figure.best(rows) for figure in figures]
    titles = [figure.title for figure in figures]
    heights = [of.get("height_m_per_px") for of in methods]
    if any(heights):
        titles.insert(1, "EPE, m of height")
    lines = []
    for row, height in zip(rows, heights):
        cells = [figure.cell(row, b) for figure, b in zip(figures, best)]
        epe = row.get("filled_epe_px")
        if any(heights):
            known = epe is not None and height is not None
            text = metres(epe, height).removesuffix(" m of height") if known else "–"
            cells.insert(1, Cell(text, f"{epe * height:.9g}" if known else "", best=cells[0].best))
        cells += [Cell(row[key], row[key]) for key in TRAINING]
        lines.append((Cell(row["method"], row["method"]), *cells))
    columns = (
        Column("method", False),
        *(Column(title, True) for title in titles),
        *(Column(title, False) for title in TRAINING.values()),
    )
    return Shown(columns, (("", tuple(lines)),))


def _by_method(rows: Sequence[Row], name: str, methods: Sequence[Row]) -> Shown:
    """A row per city or stratum, columns for each method; a group's own row stands last in it."""
    labels = [of["label"] for of in methods]
    figures = error_figures(methods)[:2]
    found = []
    for group in dict.fromkeys(row.get("group", "") for row in rows):
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


def by_strata(methods: Sequence[Row]) -> Table:
    """Where the methods differ."""
    names = list(dict.fromkeys(row["stratum"] for of in methods for row in of["strata"]))
    rows = [
        {"method": of["label"], **row}
        for name in names
        for of in methods
        for row in of["strata"]
        if row["stratum"] == name
    ]
    caption = f"EPE and D1 ({FILLED}) by what the pixels show"
    shown = [(caption, _by_method(rows, "stratum", methods))]
    return Table("strata", "Scores by what the pixels show", rows, shown)


def by_city(methods: Sequence[Row], trained: Iterable[str], *, beside_paper: bool) -> Table:
    """Scores by city, those with training tiles (``trained``) first: generalisation within cities,
    extrapolation to others."""
    table = Table("by_city", "Accuracy by city", [], [], "table 6 of the paper")
    plain = [of for of in methods if not of["fine_tuned_of"]]
    return _by_city(table, plain, set(trained), beside_paper=beside_paper)


def of_fine_tuned(methods: Sequence[Row], trained: Iterable[str], *, beside_paper: bool) -> Table:
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
        return replace(table, shown=[(text, None)], also="")
    return _by_city(table, columns, set(trained), beside_paper=beside_paper)


def _by_city(
    table: Table, methods: Sequence[Row], trained: set[str], *, beside_paper: bool
) -> Table:
    """The table with the methods' scores by city, cities with training tiles first."""
    cities = list(dict.fromkeys(row["city"] for of in methods for row in of["cities"]))
    groups = [
        ("cities with training tiles", [city for city in cities if city in trained]),
        ("cities without", [city for city in cities if city not in trained]),
    ]
    rows: list[Row] = []
    for group, members in groups:
        for city in members:
            for of in methods:
                found = next((row for row in of["cities"] if row["city"] == city), {})
                row = {"city": city, "group": group, "method": of["label"]}
                row |= {key: value for key, value in found.items() if key != "city"}
                if beside_paper and (values := _published_of(of, city)):
                    row |= dict(zip(("paper_epe_px", "paper_d1_percent"), values))
                rows.append(row)
        if len(members) > 1:
            start = {"city": "all of group", "group": group}
            rows += [start | {"method": of["label"], **_pooled(of, members)} for of in methods]
    caption = f"Ours: EPE and D1 of {FILLED}. {dataset_in_words(methods)}"
    shown: list[tuple[str, Shown | None]] = [(caption, _by_method(rows, "city", methods))]
    there: dict[tuple[str, bool], Row] = {}  # several methods here may be of one there
    for of in methods:
        there.setdefault((_kind(of), bool(of["fine_tuned_of"])), of)
    theirs = [
        {"city": city}
        | {str(k): v for k, v in enumerate(v for pair in values for v in pair or (None, None))}
        for city in cities
        if any(values := [_published_of(of, city) for of in there.values()])
    ]
    if beside_paper and theirs:
        figures = [
            figure
            for k, of in enumerate(there.values())
            for figure in (
                Figure(f"{of['label']}: EPE (px)", f"{2 * k}"),
                Figure("D1 (%)", f"{2 * k + 1}", 1, ".2f"),
            )
        ]
        shown.append((PAPERS, of_figures(theirs, {"city": "City"}, figures)))
    return replace(table, rows=rows, shown=shown)


def _published_of(of: Row, city: str) -> tuple[float, float] | None:
    """The paper's EPE and D1 of a kind of method in a city: table 7 of fine-tuned ones, else 6."""
    return (TABLE7 if of["fine_tuned_of"] else TABLE6).get(city, {}).get(_kind(of))


def _kind(of: Row) -> str:
    return of["settings"]["kind"]


def _pooled(of: Row, cities: Sequence[str]) -> dict[str, Any]:
    """Figures of all labelled pixels of some cities, of those of each."""
    rows = [row for row in of["cities"] if row["city"] in cities]
    labelled = sum(row["labelled"] for row in rows)
    found = {"tiles": sum(row["tiles"] for row in rows), "labelled": labelled}
    for key in (figure.key for figure in error_figures([of])):
        total = sum(row["labelled"] * row[key] for row in rows if row["labelled"])
        found[key] = round(total / labelled, 6) if labelled else None
    return found


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
