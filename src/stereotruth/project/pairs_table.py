"""The table of a site's pairs."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .check_table import WIDTH
from .pairs import COLUMNS, RatedPair, table


def show_pairs(
    rated: Sequence[RatedPair],
    chosen: Collection[tuple[str, str]] = (),
    console: Console | None = None,
) -> None:
    """Print a line for each pair, in the order given, and what the prediction is.

    ``chosen``: names of the images of pairs that are scenes.
    """
    console = console or Console(highlight=False)
    if not console.is_terminal:
        console = Console(width=WIDTH, highlight=False, file=console.file)
    shown = Table(box=None, pad_edge=False, show_edge=False, header_style="bold")
    for heading in COLUMNS:
        shown.add_column(heading, overflow="fold", no_wrap=heading != "reason")
    for cells in table(rated, chosen):
        shown.add_row(*map(escape, cells))
    console.print(shown)
    console.print(
        f"{len(rated)} pairs, best first. bits/px: information about the height that a pixel "
        "gives, by matched (predicted share of the pixels seen in both that semi-global matching "
        "finds within 1 px) and m/px (height that 1 px is)",
        style="dim",
    )
