"""Tables of text that users write: sheets, control points, lists of tiles; their times and numbers.

UTF-8 with or without a byte-order mark, any ends of lines, blanks around cells, blank lines. Lines
that begin with ``#`` are remarks; ``# key: value`` among them declares something. The first other
line names the columns. Numbers have a decimal point, or a comma where commas separate no cells.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path

from .errors import InputError, in_number

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
LONGEST_NUMBER = 60  # characters; a float64 has 17 digits

MOST_BYTES = 20_000_000
MOST_MISTAKES = 100  # that are told
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_DECLARED = re.compile(r"#\s*(\w+)\s*[:=]\s*(.*)")


def acquisition_time(text: str) -> datetime | date:
    """The time, UTC, or the date that a cell ``acquired`` names. ValueError says what is wrong."""
    if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text):
        return date.fromisoformat(text)
    if not re.match(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}", text):
        raise ValueError("is not of the form 2020-10-25T03:12:45Z")
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        if "Invalid isoformat" not in str(error):
            raise
        raise ValueError("is not of the form 2020-10-25T03:12:45Z") from error
    if time.tzinfo is None:
        raise ValueError("has no time zone: Z of UTC, or an offset such as +08:00")
    return time.astimezone(UTC)


def decimal_year(time: date) -> float:
    """Of a day's noon: 2020-07-02 is 2020.5 in a leap year."""
    first, last = date(time.year, 1, 1), date(time.year + 1, 1, 1)
    day = date(time.year, time.month, time.day)
    return time.year + ((day - first).days + 0.5) / (last - first).days


def epoch_year(text: str) -> float | None:
    """The decimal year that a cell names as 2016.4 or as a date; None where it is empty.

    ValueError says what is wrong.
    """
    if not text:
        return None
    if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text):
        year = decimal_year(date.fromisoformat(text))
    elif re.fullmatch(r"\d{4}(\.\d+)?", text):
        year = float(text)
    else:
        raise ValueError("is neither a decimal year nor a date")
    if not 1980 <= year < 2100:
        raise ValueError("is no epoch between 1980 and 2100")
    return year


def decimal_number(text: str) -> float:
    """The number that a word of text is, in ASCII digits with a point, as every program reads it.

    ``float`` takes more: ``1_000``, full-width digits, ``nan``. Raises ValueError.
    """
    if len(text) > LONGEST_NUMBER or not _NUMBER.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is no number")
    return float(text)


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


@dataclass(frozen=True)
class Lines:
    """Lines of a file, those of remarks empty, and what remarks declare by key in small letters."""

    file: Path
    lines: list[str]
    declared: dict[str, str]

    @classmethod
    def read(cls, file: str | Path, expected: str) -> Lines:
        """Raises InputError if it is missing, too large, or no text; then as ``expected``."""
        file = Path(file)
        try:
            if file.stat().st_size > MOST_BYTES:
                size = f"{file.stat().st_size / 1e6:.0f} MB are no table"
                raise InputError(size, file=file, remedy=expected)
            text = file.read_bytes().decode("utf-8-sig")
        except FileNotFoundError:
            raise InputError(
                "no such file", file=file, remedy="correct its path, or write it"
            ) from None
        except (UnicodeDecodeError, IsADirectoryError) as error:
            raise InputError(
                f"cannot be read as text ({error})", file=file, remedy="save it as UTF-8 text"
            ) from None
        lines, declared = text.splitlines(keepends=True), {}
        for k, line in enumerate(lines):
            remark = line.rstrip(" ,;\t\r\n").strip('" ')  # as spreadsheets save it
            if remark.startswith("#"):
                lines[k] = ""  # counted all the same
                if found := _DECLARED.fullmatch(remark):
                    declared.setdefault(found[1].lower(), found[2].strip())
        return cls(file, lines, declared)

    def number(self, text: str, what: str, line: int, *, comma: bool = False) -> float:
        """A decimal number (``comma``: perhaps with one), NaN for an empty cell.

        Raises InputError that names the line.
        """
        if not text:
            return math.nan
        try:
            return decimal_number(text.replace(",", ".") if comma else text)
        except ValueError:
            raise InputError(
                f"line {line}: {what} {text[:40]!r} is no number",
                file=self.file,
                remedy="write a decimal number",
            ) from None


@dataclass(frozen=True)
class Table(Lines):
    """``rows``: line number and cells by column of each."""

    separator: str
    columns: tuple[str, ...]
    rows: list[tuple[int, dict[str, str]]]

    @classmethod
    def read(
        cls, file: str | Path, expected: str, separators: str = ",;\t", *, ragged: bool = False
    ) -> Table:
        """A table whose cells are parted by one of the ``separators``, that of its header.

        ``expected``: remedy that names the columns; their names come in small letters. ``ragged``:
        empty cells at the end of a line may be left out.

        Raises InputError: see :meth:`Lines.read`; no header, a column that occurs twice, a row with
        more or fewer cells than columns, a last row that is cut.
        """
        read = Lines.read(file, expected)
        file = read.file
        first = next((line for line in read.lines if line.strip()), "")
        separator = max(separators, key=first.count)
        reader = csv.reader(read.lines, delimiter=separator, strict=True)
        columns: list[str] = []
        rows = []
        try:
            for row in reader:
                cells, number = [cell.strip() for cell in row], reader.line_num
                if not any(cells):
                    continue
                if not columns:
                    columns = [cell.lower() for cell in cells]
                    continue
                is_cut = number == len(read.lines) and not read.lines[-1].endswith(("\n", "\r"))
                short = len(cells) < len(columns)
                if len(cells) > len(columns) or (short and (is_cut or not ragged)):
                    raise InputError(
                        f"line {number} has {len(cells)} cells for {len(columns)} columns"
                        + (", and the file ends there" if short and is_cut else ""),
                        file=file,
                        remedy="see that the file is whole: a cell for each column, and an end of "
                        "the line",
                    )
                cells += [""] * (len(columns) - len(cells))
                rows.append((number, dict(zip(columns, cells))))
        except csv.Error as error:
            raise InputError(
                f"line {reader.line_num + 1} cannot be read ({error})",
                file=file,
                remedy=f"save it as text, with {SEPARATORS[separator]} between cells",
            ) from None
        if not columns:
            raise InputError("it is empty", file=file, remedy=expected)
        require_unique(columns, "column", file)
        return cls(file, read.lines, read.declared, separator, tuple(columns), rows)

    def require(
        self, needed: Collection[str], known: Collection[str] | None, expected: str
    ) -> None:
        """Raise InputError for a column that is missing, or is none of the ``known``."""
        wrong = [f"column {c!r} is missing" for c in needed if c not in self.columns]
        unknown = [c for c in self.columns if known is not None and c not in known]
        wrong += [f"column {c[:40]!r} is unknown" for c in unknown[:8]]
        if wrong:
            named = SEPARATORS[self.separator]
            parted = "" if len(self.columns) > 1 else f" (are the columns separated by {named}?)"
            raise InputError("; ".join(wrong) + parted, file=self.file, remedy=expected)

    def number_of(self, cells: dict[str, str], column: str, line: int) -> float:
        """The number in a cell; see :meth:`Lines.number`."""
        return self.number(cells[column], column, line, comma=self.separator != ",")


def require_unique(values: Iterable[str], column: str, file: Path) -> None:
    """Raise InputError if a value of a column stands in two rows."""
    twice = [value for value, n in Counter(values).items() if n > 1]
    if twice:
        raise InputError(
            f"{column} {twice[0]!r} stands in more than one row",
            file=file,
            remedy=f"give each row a {column} of its own",
        )
