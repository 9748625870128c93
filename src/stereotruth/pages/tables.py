"""Values and tables of a page: what stands in CSV and JSON files, as people read it."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

ABBREVIATIONS = {"gcp": "GCP", "sift": "SIFT", "lidar": "LiDAR", "nmad": "NMAD"}


@dataclass(frozen=True)
class Headline:
    """One of the figures on top: what, how much, a remark, and whether it misses a limit."""

    title: str
    value: str
    note: str = ""
    bad: bool = False


@dataclass(frozen=True)
class Cell:
    """A value of a table: what is shown, what it is sorted by, whether it misses a limit.

    ``best``: whether it is the best of its kind; ``href``: where a click leads; ``pictures``: data
    URIs, shown instead of the text.
    """

    text: str
    key: str
    bad: bool = False
    best: bool = False
    href: str = ""
    pictures: tuple[str, ...] = ()


EMPTY = Cell("–", "")


@dataclass(frozen=True)
class Column:
    """A column's heading, and whether its values are numbers."""

    title: str
    numeric: bool


@dataclass(frozen=True)
class Table:
    """A table of the page; ``groups`` are rows that belong together, under a heading or none."""

    columns: tuple[Column, ...]
    groups: tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]

    @classmethod
    def of(
        cls, titles: Sequence[str], lines: Iterable[Sequence[Cell]], words: Collection[int] = (0,)
    ) -> Table | None:
        """One group of lines; ``words``: columns that are no numbers. None of no line."""
        group = tuple(map(tuple, lines))
        columns = tuple(Column(title, k not in words) for k, title in enumerate(titles))
        return cls(columns, (("", group),)) if group else None


def words(name: str) -> str:
    """A column's name in words: underscores go, a unit at the end stands apart."""
    text = name.removeprefix("count_").replace("y_parallax", "y-parallax")
    unit = ""
    if "share" in text:  # shown in percent
        text = text.removeprefix("share_").removeprefix("of_")
    else:
        for end in ("px", "m", "degrees"):
            if text.endswith(f"_{end}"):
                text, unit = text.removesuffix(f"_{end}"), f", {end}"
    return " ".join(ABBREVIATIONS.get(word, word) for word in text.split("_")) + unit


def gate(name: str) -> str:
    """What a missed gate of the configuration says: ``max_…`` too high, ``min_…`` too low."""
    text = words(name.removeprefix("max_").removeprefix("min_")).removesuffix(", px")
    ending = {"max": " too high", "min": " too low"}.get(name[:3], "")
    return text + ending


def limit(name: str, value: float) -> str:
    """A limit of the configuration in words."""
    text, _, unit = words(name.removeprefix("max_").removeprefix("min_")).partition(", ")
    return f"{text} {'≥' if name.startswith('min_') else '≤'} {value:g} {unit}".strip()


def number(text: str) -> float | None:
    """The finite number that a text says, else None."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if np.isfinite(value) else None


def minus(text: str) -> str:
    """A number's text with the true minus sign, and none before a zero."""
    return re.sub(r"-(?=0\.?0*(?![\d.]))", "", text).replace("-", "−")


def show(name: str, text: str) -> str:
    """A value of the column ``name`` as people read it: shares in percent, else 3 decimals."""
    value = number(text)
    if value is None:
        return text
    if "share" in name:
        return minus(f"{100 * value:.2f} %")
    if value == int(value) and "." not in text:
        whole = f"{int(value)}"
        return minus(f"{int(value):,}".replace(",", " ") if len(whole) > 5 else whole)
    if name in ("lon", "lat"):
        return minus(f"{value:.5f}")
    if name == "days" or name.endswith("_degrees"):
        return minus(f"{value:.1f}")
    return minus(f"{value:.3f}")


def value_cell(
    value: float | None, form: str, factor: float = 1, unit: str = "", **more: Any
) -> Cell:
    """A number's cell, sorted by its value; a dash of None."""
    if value is None:
        return EMPTY
    return Cell(minus(f"{factor * value:{form}}{unit}"), f"{value:.9g}", **more)


def link_cell(text: str, href: str | None, **more: Any) -> Cell:
    """A text that leads somewhere."""
    return Cell(text, text, href=href or "", **more)


def joined(*parts: str | None) -> str:
    """Those parts of a remark that there are."""
    return "; ".join(part for part in parts if part)


def cell(name: str, text: str, bad: bool = False) -> Cell:
    """A table's cell of a value as it stands in a CSV file."""
    value = number(text)
    return Cell(show(name, text), text if value is None else f"{value:.9g}", bad)


def table(
    rows: Sequence[Mapping[str, str]],
    columns: Sequence[str] | None = None,
    links: Mapping[str, Mapping[str, str]] | None = None,
) -> Table | None:
    """A table of CSV rows, with the given columns or all; None of no rows.

    ``links``: by column, where its texts lead.
    """
    if not rows:
        return None
    names = list(rows[0]) if columns is None else [c for c in columns if c in rows[0]]
    ways = [(links or {}).get(name, {}) for name in names]
    lines = tuple(
        tuple(replace(c, href=to.get(c.text, "")) for c, to in zip(cells_of(names, row), ways))
        for row in rows
    )
    return Table(columns_of(names, rows), (("", lines),))


def texts(row: Mapping[str, Any]) -> dict[str, str]:
    """A record's values as a CSV file has them: nothing of None."""
    return {key: "" if value is None else str(value) for key, value in row.items()}


def columns_of(names: Iterable[str], rows: Sequence[Mapping[str, str]]) -> tuple[Column, ...]:
    """Headings of named columns; numeric are those that hold nothing but numbers."""

    def numeric(name: str) -> bool:
        values = [row[name] for row in rows if row.get(name)]
        return bool(values) and all(number(value) is not None for value in values)

    return tuple(Column(words(name), numeric(name)) for name in names)


def cells_of(names: Iterable[str], row: Mapping[str, str]) -> tuple[Cell, ...]:
    """Cells of named columns; a missed gate in the column ``quality`` is bad."""
    return tuple(
        cell(name, row.get(name) or "", name == "quality" and bool(missed(row))) for name in names
    )


def missed(row: Mapping[str, Any]) -> list[str]:
    """Names of the quality gates that a tile of the manifest misses."""
    text = row.get("quality") or "ok"
    return [] if text == "ok" else [name.strip() for name in text.split(";") if name.strip()]


def metres(value_px: float, height_m_per_px: float | None, *, what: str = "height") -> str:
    """A disparity in px as metres of height, to two digits; nothing where the ratio is unknown."""
    if height_m_per_px is None:
        return ""
    value = abs(value_px) * height_m_per_px
    text = f"{value:.0f}" if value >= 10 else f"{value:#.2g}"
    return f"{text} m of {what}"


def spread(values: Iterable[float | None], form: str) -> str:
    """One value, or the least and the largest of several; a dash of none."""
    known = sorted(v for v in values if v is not None)
    if not known:
        return "–"
    low, high = (minus(format(v, form)) for v in (known[0], known[-1]))
    return low if low == high else f"{low}{' … ' if '−' in low + high else '–'}{high}"
