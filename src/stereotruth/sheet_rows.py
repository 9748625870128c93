"""The rows of a tab-separated sheet, and what is wrong in them, told all at once."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path

from .errors import InputError, in_number

MOST_BYTES = 20_000_000  # of a sheet
MOST_MISTAKES = 100  # that are told


class SheetError(InputError):
    """Several mistakes in a sheet, of which the message tells the first.

    ``each`` has an InputError for each wrong row, then one for each column that repeats a value.
    """

    def __init__(self, each: Sequence[InputError]) -> None:
        first, self.each = each[0], tuple(each)
        others = in_number(len(each) - 1, "more mistake")
        super().__init__(
            f"{first.problem} (and {others}: stereotruth check tells all)",
            file=first.file,
            remedy=first.remedy,
        )


class Mistakes(list[InputError]):
    """What is wrong in the rows of a sheet, so that all of it is told at once."""

    @contextmanager
    def collect(self) -> Iterator[None]:
        """In the block, an InputError is kept, after which the block ends.

        Raises SheetError where they are :data:`MOST_MISTAKES`.
        """
        try:
            yield
        except InputError as error:
            self.append(error)
            if len(self) == MOST_MISTAKES:
                self.refuse()

    def refuse(self) -> None:
        """Raise InputError if there is any."""
        if self:
            raise (self[0] if len(self) == 1 else SheetError(self)) from None


def read_table(path: Path, sheet: type) -> list[tuple[int, dict[str, str]]]:
    """(line number, cells) of each row of a tab-separated sheet; a cell is empty where none is.

    ``sheet``: dataclass whose fields are the columns. Raises InputError that names line or column.
    """
    columns = [f.name for f in fields(sheet)]
    needed = [f.name for f in fields(sheet) if f.default is MISSING]
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(
                f"{path.stat().st_size / 1e6:.0f} MB are no sheet",
                file=path,
                remedy=f"its columns are {', '.join(columns)}",
            )
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(
            "no such file", file=path, remedy="correct its path in the config, or write it"
        ) from None
    except (UnicodeDecodeError, IsADirectoryError) as error:
        raise InputError(str(error), file=path, remedy="save it as UTF-8 text") from None
    lines = text.splitlines(keepends=True)
    rows = csv.reader(lines, delimiter="\t")
    try:
        numbered = [(n, [c.strip() for c in row]) for n, row in enumerate(rows, 1) if any(row)]
    except csv.Error as error:
        raise InputError(
            f"no sheet of text ({error})", file=path, remedy="save it as text with tabs"
        ) from None
    numbered = [(n, row) for n, row in numbered if not row[0].startswith("#")]
    if not numbered:
        raise InputError("empty sheet", file=path, remedy=f"its columns are {', '.join(columns)}")
    header = numbered[0][1]
    missing = [c for c in needed if c not in header]
    unknown = [c for c in header if c not in columns]
    if missing or unknown:
        tabs = "" if len(header) > 1 else " (are the columns separated by tabs?)"
        wrong = [f"column {c!r} is missing" for c in missing]
        wrong += [f"column {c!r} is unknown" for c in unknown]
        optional = [c for c in columns if c not in needed]
        more = f"; {' and '.join(optional)} may be left out" if optional else ""
        raise InputError(
            "; ".join(wrong) + tabs,
            file=path,
            remedy=f"the columns are {', '.join(columns)}{more}",
        )
    table = []
    for number, row in numbered[1:]:
        if len(row) > len(header):
            raise InputError(
                f"line {number} has {len(row)} cells for {len(header)} columns",
                file=path,
                remedy="remove the surplus tab",
            )
        if len(row) < len(header) and number == len(lines) and not lines[-1].endswith("\n"):
            raise InputError(
                f"line {number} ends after {len(row)} of {len(header)} columns, and the file there",
                file=path,
                remedy="see that the file is whole, and end the line",
            )
        row += [""] * (len(header) - len(row))
        table.append((number, dict.fromkeys(columns, "") | dict(zip(header, row))))
    return table


def require_unique(values: Iterable[str], column: str, file: Path) -> None:
    """Raise InputError if a value of a column stands in two rows."""
    twice = [value for value, n in Counter(values).items() if n > 1]
    if twice:
        raise InputError(
            f"{column} {twice[0]!r} stands in more than one row",
            file=file,
            remedy=f"give each row a {column} of its own",
        )
