"""The table of a check."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .findings import Findings, Level

STYLES = {Level.FACT: "green", Level.DOUBT: "yellow", Level.ERROR: "bold red"}
WIDTH = 160  # where the output is no terminal


def show(every: Sequence[Findings], console: Console | None = None) -> bool:
    """Print one table, problems with their remedies below them; whether a run would fail."""
    console = console or Console(highlight=False)
    if not console.is_terminal:
        console = Console(width=WIDTH, highlight=False, file=console.file)
    table = Table(box=None, pad_edge=False, show_edge=False, header_style="bold")
    for heading in ("scene", "about", "", "finding"):
        table.add_column(heading, overflow="fold", no_wrap=heading in ("scene", ""))
    counts = dict.fromkeys((Level.ERROR, Level.DOUBT, Level.FACT), 0)
    for findings in every:
        for k, found in enumerate(findings):
            counts[found.level] += 1
            style = STYLES[found.level]
            text = escape(found.text)
            if found.remedy:
                text += f"\n[dim]Remedy:[/dim] {escape(found.remedy)}"
            mark = f"[{style}]{found.level.value}[/{style}]"
            table.add_row(escape(found.scene) if k == 0 else "", found.about, mark, text)
    console.print(table)
    failed = any(findings.failed for findings in every)
    verdict = "a run would fail" if failed else "a run can begin"
    numbers = ", ".join(
        f"{n} {level.value}{'s' * (n != 1)}"
        for level, n in counts.items()
        if level is not Level.FACT
    )
    console.print(
        f"{numbers}: {verdict}",
        style="bold red" if failed else "bold green",
    )
    return failed
