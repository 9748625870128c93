"""The sections of a benchmark's page: its tables, under headings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ...pages.tables import Table
from . import tables


@dataclass(frozen=True)
class Section:
    """A part of the page: heading, what it is called in the paper, tables with captions."""

    name: str
    heading: str
    also: str
    shown: tuple[tuple[str, Table | None], ...]


def sections(found: Sequence[tables.Table], protocol: str) -> list[Section]:
    """Sections of all tables, in their order; the page names their ``protocol`` once, on top.

    A table without rows has none.
    """
    result = []
    for table in found:
        if not any(t.groups for _, t in table.shown):
            continue
        title = table.title.removesuffix(f" ({protocol})")
        before, _, heading = title.partition(": ")
        is_number = bool(re.fullmatch(r"Table \d+", before))
        heading = heading if is_number else title
        also = f"{before.lower()} of the paper" if is_number else ""
        shown = tuple((of.replace("`", ""), t if t.groups else None) for of, t in table.shown)
        result.append(Section(table.name, heading[0].upper() + heading[1:], also, shown))
    return result
