"""The methods of a dataset side by side: tables 5, 6 and 7 of the paper, and one by strata.

Made from the ``scores.json`` of each method. Figures are those of all labelled pixels, holes
filled, so that methods with and without holes compare; those of the valid pixels alone stand beside
them. CSV files hold all, with confidence intervals and the paper's figures (columns ``paper_…``: on
the real WHU-Stereo, by methods trained on it), Markdown files what fits a page.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...products.files import replacing, write_table
from ..kinds import KINDS
from . import published_scores

Row = dict[str, Any]


PAPERS = "The paper's, on the real WHU-Stereo"
FILLED = "all labelled pixels, holes filled"


@dataclass(frozen=True)
class Table:
    """Rows for a CSV file, and one or more tables (caption, heading, lines) to read."""

    name: str
    title: str
    rows: Sequence[Row]
    shown: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]]

    @property
    def columns(self) -> list[str]:
        """Of the CSV file, in order of appearance."""
        return list(dict.fromkeys(key for row in self.rows for key in row)) or ["method"]

    def by(self, protocol: str) -> Table:
        """The table with the id of the protocol that its scores are made by."""
        rows = [{"protocol": protocol, **row} for row in self.rows]
        return replace(self, title=f"{self.title} ({protocol})", rows=rows)

    def markdown(self) -> str:
        """What is to be read."""
        parts = [f"# {self.title}"]
        for caption, heading, lines in self.shown:
            table = [heading, ["---", *["---:"] * (len(heading) - 1)], *lines]
            parts.append("\n".join(f"| {' | '.join(line)} |" for line in table))
            parts[-1] = f"{caption}\n\n{parts[-1]}"
        return "\n\n".join(parts) + "\n"


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
        table5(methods, beside_paper=beside_paper),
        table6(methods, trained, beside_paper=beside_paper),
        table7(methods, trained, beside_paper=beside_paper),
        by_strata(methods),
    ]


def write_tables(tables: Iterable[Table], folder: str | Path) -> None:
    """``<name>.csv`` and ``<name>.md`` of each."""
    for table in tables:
        write_table(Path(folder) / f"{table.name}.csv", table.rows, table.columns)
        with replacing(Path(folder) / f"{table.name}.md") as scratch:
            scratch.write_text(table.markdown(), encoding="utf-8")


def table5(methods: Sequence[Row], *, beside_paper: bool) -> Table:
    """Accuracy, completeness, time and memory of the methods over all tiles."""
    rows, lines = [], []
    for of in methods:
        d1 = _d1(of)
        row = {
            "method": of["label"],
            "kind": of["settings"]["kind"],
            **{key: value for key, value in of["all"].items() if key != "city"},
            "median_seconds": of["median_seconds"],
            "peak_memory_mb": of["peak_memory_mb"],
            "device": of["device"],
            "threads": of["threads"],
        }
        published = published_scores.TABLE5.get(_kind(of)) if beside_paper else None
        if published and not of["fine_tuned_of"]:
            keys = ("paper_epe_px", "paper_d1_percent", "paper_ms")
            row |= dict(zip(keys, published))
        rows.append(row)
        lines.append(
            [
                of["label"],
                _px(of["all"], "filled_epe_px"),
                _percent(of["all"], f"filled_{d1}"),
                *(
                    _percent(of["all"], f"filled_d1_{limit:g}_px_share", interval=False)
                    for limit in of["thresholds_px"][1:]
                ),
                _number(of["all"].get("median_px"), 1, ".3f"),
                _px(of["all"], "epe_px", interval=False),
                _percent(of["all"], d1, interval=False),
                _percent(of["all"], "valid_share", interval=False),
                _number(of["median_seconds"], 1000, ".0f"),
                _number(of["peak_memory_mb"], 1, ".0f"),
            ]
        )
    limits = methods[0]["thresholds_px"] if methods else [3.0]
    heading = [
        "Method",
        "EPE (px)",
        f"D1, {limits[0]:g} px (%)",
        *(f"D1, {limit:g} px (%)" for limit in limits[1:]),
        "valid only: median (px)",
        "EPE (px)",
        "D1 (%)",
        "valid (%)",
        "Time (ms)",
        "Memory (MB)",
    ]
    shown = [
        (
            f"Ours: {FILLED}, with 95 % confidence; then valid pixels only. {_what(methods)}",
            heading,
            lines,
        )
    ]
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
    return Table("table5", "Table 5: accuracy, time and memory", rows, shown)


def table6(methods: Sequence[Row], trained: set[str], *, beside_paper: bool) -> Table:
    """Scores by city: generalisation within cities, extrapolation to others."""
    title = "Table 6: accuracy by city"
    return _by_city("table6", title, _plain(methods), trained, beside_paper=beside_paper)


def table7(methods: Sequence[Row], trained: set[str], *, beside_paper: bool) -> Table:
    """Fine-tuned methods by city, beside the same methods trained on this dataset alone."""
    title = "Table 7: fine-tuned methods by city"
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
        return Table("table7", title, [], [(text, ["Method"], [])])
    return _by_city("table7", title, columns, trained, beside_paper=beside_paper)


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
    heading, lines = _heading("Pixels", methods), []
    for name in names:
        line = [name.replace("_", " ")]
        for of in methods:
            line += _epe_d1(of, found[of["method"]].get(name))
        lines.append(line)
    caption = f"EPE and D1 ({FILLED}) by what the pixels show"
    return Table("strata", "Scores by what the pixels show", rows, [(caption, heading, lines)])


def _by_city(
    name: str,
    title: str,
    methods: Sequence[Row],
    trained: set[str],
    *,
    beside_paper: bool,
) -> Table:
    cities = list(dict.fromkeys(row["city"] for of in methods for row in of["cities"]))
    groups = [
        ("cities with training tiles", [city for city in cities if city in trained]),
        ("cities without", [city for city in cities if city not in trained]),
    ]
    rows, lines = [], []
    for group, members in groups:
        for city in members:
            for of in methods:
                row = {"city": city, "group": group, "method": of["label"], **_city(of, city)}
                if beside_paper and (values := _published_of(of, city)):
                    row |= dict(zip(("paper_epe_px", "paper_d1_percent"), values))
                rows.append(row)
            lines.append([city, *(cell for of in methods for cell in _epe_d1(of, _city(of, city)))])
        if len(members) > 1:
            pooled = [_pooled(of, members) for of in methods]
            rows += [
                {"city": "all of group", "group": group, "method": of["label"], **row}
                for of, row in zip(methods, pooled)
            ]
            cells = [cell for of, row in zip(methods, pooled) for cell in _epe_d1(of, row)]
            lines.append([f"**{group}**", *(f"**{cell}**" for cell in cells)])
    shown = [(f"Ours: EPE and D1 of {FILLED}. {_what(methods)}", _heading("City", methods), lines)]
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
    return Table(name, title, rows, shown)


def _published_of(of: Row, city: str) -> tuple[float, float] | None:
    """The paper's EPE and D1 of a kind of method in a city: table 7 of fine-tuned ones, else 6."""
    table = published_scores.TABLE7 if of["fine_tuned_of"] else published_scores.TABLE6
    return table.get(city, {}).get(_kind(of))


def _published(
    heading: Sequence[str], lines: Sequence[Sequence[str]]
) -> list[tuple[str, Sequence[str], Sequence[Sequence[str]]]]:
    return [(f"{PAPERS}.", heading, lines)] if lines else []


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


def _d1(of: Row) -> str:
    """Name of the figure of the first threshold."""
    return f"d1_{of['thresholds_px'][0]:g}_px_share"


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


def _epe_d1(of: Row, row: Row | None) -> list[str]:
    row = row or {}
    return [
        _number(row.get("filled_epe_px"), 1, ".3f"),
        _number(row.get(f"filled_{_d1(of)}"), 100, ".2f"),
    ]


def _px(row: Row, key: str, *, interval: bool = True) -> str:
    return with_interval(row, key, 1, ".3f", shown=interval)


def _percent(row: Row, key: str, *, interval: bool = True) -> str:
    return with_interval(row, key, 100, ".2f", shown=interval)


def with_interval(row: Row, key: str, factor: float, form: str, *, shown: bool = True) -> str:
    """A figure and, where there is one and it is to be shown, its interval."""
    text = _number(row.get(key), factor, form)
    ends = [row.get(f"{key}_{end}") for end in ("low", "high")]
    if shown and None not in ends:
        text += f" [{', '.join(_number(end, factor, form) for end in ends)}]"
    return text


def _number(value: float | None, factor: float, form: str) -> str:
    return "–" if value is None else format(factor * value, form)


def _what(methods: Sequence[Row]) -> str:
    """Dataset, split, pairs and range."""
    if not methods:
        return ""
    of = methods[0]
    low, high = of["disparity_range"]
    split = f"split {of['split']}" if of["split"] else "all splits"
    exact = of.get("protocol", {}).get("truth") == "exact"
    more = " Labelled: by the exact truth, all that both views see." if exact else ""
    where = (
        f"Dataset {of['dataset']}, {split}, {of['tiles']} pairs, disparities [{low}, {high}) px."
    )
    return where + more
