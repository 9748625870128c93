"""The tables of a benchmark's page: what the CSV files hold, the best of its kind in bold.

Best is the least error, time and memory, and the largest share of valid pixels, among the methods
and where there are at least two; it stands with its 95 % interval where there is one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...products.html_tables import Cell, Column, Table, metres, minus
from . import tables
from .tables import with_interval

Row = Mapping[str, Any]
NOTHING = Cell("–", "")


@dataclass(frozen=True)
class Section:
    """A part of the page: heading, what it is called in the paper, tables with captions."""

    name: str
    heading: str
    also: str
    shown: tuple[tuple[str, Table | None], ...]


@dataclass(frozen=True)
class Figure:
    """How a figure of the scores is shown: title, key, factor, format, whether more is better."""

    title: str
    key: str
    factor: float = 1
    form: str = ".3f"
    more: bool = False

    def cell(self, row: Row, best: float | None, *, interval: bool = False) -> Cell:
        """The figure of a row; ``best`` of all rows, which stands with its interval."""
        value = row.get(self.key)
        if value is None:
            return NOTHING
        is_best = best is not None and value == best
        text = with_interval(dict(row), self.key, self.factor, self.form, shown=interval or is_best)
        return Cell(minus(text), f"{value:.9g}", best=is_best)

    def best(self, rows: Sequence[Row]) -> float | None:
        """The best of at least two values."""
        values = [row[self.key] for row in rows if row.get(self.key) is not None]
        if len(values) < 2:
            return None
        return max(values) if self.more else min(values)


def sections(
    found: Sequence[tables.Table], methods: Sequence[Row], limits: Sequence[float]
) -> list[Section]:
    """Sections of all tables, in their order; ``methods``: summaries; ``limits``: of D1, px."""
    d1 = f"filled_d1_{limits[0]:g}_px_share"
    pair = (Figure("EPE, px", "filled_epe_px"), Figure("D1, %", d1, 100, ".2f"))
    made: dict[str, Callable[[tables.Table], Table]] = {
        "table5": lambda of: _accuracy(of.rows, methods, limits),
        "table6": lambda of: _by_method(of.rows, "city", pair),
        "table7": lambda of: _by_method(of.rows, "city", pair),
        "strata": lambda of: _by_method(of.rows, "stratum", pair),
    }
    result = []
    for table in found:
        before, _, heading = table.title.partition(": ")
        is_number = bool(re.fullmatch(r"Table \d+", before))
        heading = heading if is_number else table.title
        shown = list(table.shown)
        parts: list[tuple[str, Table | None]] = []
        if table.name in made and table.rows:
            caption, *_ = shown.pop(0)
            parts.append((_plain(caption), made[table.name](table)))
        parts += [(_plain(c), _as_written(h, lines) if lines else None) for c, h, lines in shown]
        also = f"{before.lower()} of the paper" if is_number else ""
        result.append(Section(table.name, heading[0].upper() + heading[1:], also, tuple(parts)))
    return result


def _accuracy(rows: Sequence[Row], methods: Sequence[Row], limits: Sequence[float]) -> Table:
    """A row per method."""
    first = limits[0]
    figures = [
        Figure("EPE, px", "filled_epe_px"),
        *(
            Figure(f"D1, {limit:g} px, %", f"filled_d1_{limit:g}_px_share", 100, ".2f")
            for limit in limits
        ),
        Figure("valid only: median, px", "median_px"),
        Figure("valid only: EPE, px", "epe_px"),
        Figure(f"valid only: D1, {first:g} px, %", f"d1_{first:g}_px_share", 100, ".2f"),
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
        lines.append((Cell(row["method"], row["method"]), *cells))
    titles = [figure.title for figure in figures]
    if any(heights):
        titles.insert(1, "EPE, m of height")
    columns = (Column("method", False), *(Column(title, True) for title in titles))
    return Table(columns, (("", tuple(lines)),))


def _by_method(rows: Sequence[Row], name: str, figures: Sequence[Figure]) -> Table:
    """A row per city or stratum, columns for each method; sums of groups stand last in theirs."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
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
                for method in methods
                for figure, b in zip(figures, best)
            ]
            text = value.replace("_", " ")
            lines.append((Cell(text, text), *cells))
        found.append((group, tuple(lines)))
    titles = [f"{method}: {figure.title}" for method in methods for figure in figures]
    first = "pixels" if name == "stratum" else name
    columns = (Column(first, False), *(Column(title, True) for title in titles))
    return Table(columns, tuple(found))


def _as_written(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> Table:
    """A table of Markdown cells, sorted by the numbers that they begin with."""
    cells = [tuple(_cell(text) for text in line) for line in lines]
    numeric = [
        column > 0 and all(_number(line[column]) is not None for line in lines if line[column])
        for column in range(len(heading))
    ]
    columns = tuple(Column(_plain(name), numeric[k]) for k, name in enumerate(heading))
    return Table(columns, (("", tuple(cells)),))


def _number(text: str) -> str | None:
    """The number that a cell begins with; empty of a dash, None of words."""
    if text.strip("*") == "–":
        return ""
    begins = re.match(r"[+-]?\d+(\.\d+)?(?=$|\s|\*)", text.removeprefix("**"))
    return begins[0] if begins else None


def _cell(text: str) -> Cell:
    number = _number(text)
    plain = _plain(text)
    bold = text.startswith("**")
    return replace(Cell(plain, plain if number is None else number.lstrip("+")), best=bold)


def _plain(text: str) -> str:
    """A text of Markdown without marks, with true minus signs."""
    return re.sub(r"(?<!\w)-(?=\d)", "−", text.replace("**", "").replace("`", ""))
