"""What a check has to say, and tables of that on a terminal."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import Enum

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..core.errors import InputError, told_by_system
from ..core.tables import SheetError

HEADINGS = ("project", "images", "run")  # of findings that are of no scene
WIDTH = 160  # where the output is no terminal


class Level(Enum):
    """What a finding means for a run."""

    FACT = "ok"
    DOUBT = "doubt"  # a run goes through, and may not give what is wanted
    ERROR = "error"  # a run would fail of it


@dataclass(frozen=True)
class Finding:
    """One line of the table: of which scene or city, of what, and what to do about it."""

    scene: str
    about: str
    level: Level
    text: str
    remedy: str = ""


@contextmanager
def heard(name: str, level: int = logging.NOTSET) -> Iterator[list[logging.LogRecord]]:
    """What a logger is told in the block, from a level on."""
    records: list[logging.LogRecord] = []
    listener = logging.Handler(level)
    listener.emit = records.append
    logger = logging.getLogger(name)
    logger.addHandler(listener)
    try:
        yield records
    finally:
        logger.removeHandler(listener)


class Findings(list[Finding]):
    """What is found of one scene; InputErrors and warnings of the stages become findings."""

    def __init__(self, scene: str = "") -> None:
        super().__init__()
        self.scene = scene

    def say(self, about: str, level: Level, text: str, remedy: str = "") -> None:
        """Add a finding, once."""
        if not any((f.about, f.level, f.text) == (about, level, text) for f in self):
            self.append(Finding(self.scene, about, level, text, remedy))

    def fact(self, about: str, text: str) -> None:
        """Add what is so."""
        self.say(about, Level.FACT, text)

    def doubt(self, about: str, text: str, remedy: str = "") -> None:
        """Add what a run goes through with, and may not be what is wanted."""
        self.say(about, Level.DOUBT, text, remedy)

    def fault(self, about: str, text: str, remedy: str = "") -> None:
        """Add what a run would fail of."""
        self.say(about, Level.ERROR, text, remedy)

    def error(self, about: str, error: InputError) -> None:
        """Add what a stage refuses; of a sheet all that is wrong in it."""
        for each in error.each if isinstance(error, SheetError) else (error,):
            self.fault(about, f"{each.file}: " * bool(each.file) + each.problem, each.remedy)

    @contextmanager
    def of(self, about: str) -> Iterator[None]:
        """In the block, an InputError is a finding, after which the block ends; warnings too.

        So is what the operating system refuses.
        """
        with heard("stereotruth", logging.WARNING) as records:
            try:
                yield
            except InputError as error:
                self.error(about, error)
            except OSError as error:  # no permission, or gone in this moment
                if (told := told_by_system(error)) is None:
                    raise
                self.error(about, told)
        for record in records:
            self.doubt(about, record.getMessage().removeprefix("warning: "))

    @property
    def failed(self) -> bool:
        """Whether a run would fail."""
        return any(finding.level is Level.ERROR for finding in self)


STYLES = {Level.FACT: "green", Level.DOUBT: "yellow", Level.ERROR: "bold red"}


def said_once(every: Sequence[Findings]) -> list[tuple[str, list[Finding]]]:
    """Headings of the table with their findings. A doubt or an error of several scenes, and a fact
    of all, stands once, under their number and before the scenes; its ``scene`` names them unless
    these are all."""
    of: dict[Finding, list[str]] = {}
    for findings in every:
        for found in findings:
            of.setdefault(replace(found, scene=""), []).append(findings.scene)
    scenes = [findings.scene for findings in every if findings.scene not in HEADINGS]
    together: dict[int, list[Finding]] = {}
    shared = set()
    for found, names in of.items():
        if len(names) > max(len(scenes) - 1 if found.level is Level.FACT else 1, 1):
            shared.add(found)
            named = replace(found, scene=", ".join(names) if len(names) < len(scenes) else "")
            together.setdefault(len(names), []).append(named)
    parts: list[tuple[str, list[Finding]]] = []
    for findings in every:
        if scenes and findings.scene == scenes[0]:
            for count, found in sorted(together.items(), reverse=True):
                parts.append((f"{'all ' * (count == len(scenes))}{count} scenes", found))
        own = [found for found in findings if replace(found, scene="") not in shared]
        parts.append((findings.scene, own))
    return parts


def wide(console: Console | None = None) -> Console:
    """A console of WIDTH characters, where it is no terminal, which has a width of its own."""
    console = console or Console(highlight=False)
    if console.is_terminal:
        return console
    return Console(width=WIDTH, highlight=False, file=console.file)


def plain_table(headings: Sequence[str], whole: Collection[str] = ()) -> Table:
    """A table without lines; the columns ``whole`` are not broken."""
    table = Table(box=None, pad_edge=False, show_edge=False, header_style="bold")
    for heading in headings:
        table.add_column(heading, overflow="fold", no_wrap=heading in whole)
    return table


def show(every: Sequence[Findings], console: Console | None = None) -> bool:
    """Print one table, problems with their remedies below them; whether a run would fail."""
    console = wide(console)
    table = plain_table(("scene", "about", "", "finding"), whole=("scene", ""))
    counts = dict.fromkeys((Level.ERROR, Level.DOUBT, Level.FACT), 0)
    for scene, findings in said_once(every):
        for k, found in enumerate(findings):
            counts[found.level] += 1
            style = STYLES[found.level]
            text = escape(found.text)
            if found.remedy:
                text += f"\n[dim]Remedy:[/dim] {escape(found.remedy)}"
            if "," in found.scene:
                text += f"\n[dim]Scenes:[/dim] {escape(found.scene)}"
            mark = f"[{style}]{found.level.value}[/{style}]"
            table.add_row(escape(scene) if k == 0 else "", found.about, mark, text)
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
