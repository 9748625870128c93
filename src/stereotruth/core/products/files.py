"""Files and folders that are whole or absent, CSV and JSON, and names that others state.

Manifests, results and submissions of others say what products are called. Such a name must be a
plain one: part of one file name, and nothing that leads elsewhere.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from .provenance import own_digest

Made = TypeVar("Made")
LONGEST_NAME = 100  # bytes; a file's name has 255, with what is added to it

RUN = re.compile(r"'*[=+\-@\t\r]")  # begins what spreadsheets take for a formula
MARK = "'"  # before such texts


def damaged_store(store: Path, name: str) -> InputError:
    """What is said of a file ``name`` of a ``store`` that is not as it was written."""
    return InputError(
        "damaged: it is not what was written",
        file=store / name,
        remedy=f"delete {store} and run the workflow again",
    )


FOREIGN = (  # what other programs leave beside the files that they open; in lower case
    "*.aux.xml",  # GDAL, QGIS: statistics
    "*.ovr",  # GDAL, QGIS: pyramids
    *("*.qgs", "*.qgz", "*.qgs~", "*.qgz~", "*.qml", "*.qmd", "*.points"),  # QGIS
    *(".ds_store", "._*", "thumbs.db", "desktop.ini", ".directory"),  # file managers
    ".snakemake_timestamp",  # Snakemake, in folders that rules make
)

LONGEST_PATH = 1000  # bytes of a path below a folder


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A scratch file beside ``path``, of its suffix, that takes its place if the block ends well.

    The folder is made. If the block fails, the scratch file goes and ``path`` stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        yield scratch
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """An empty scratch folder beside ``path`` that takes its place if the block ends well.

    If the block fails, the scratch folder goes and ``path`` stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch, old = path.with_name(f"{path.name}.partial"), path.with_name(f".{path.name}.old")
    for rest in (scratch, old):
        shutil.rmtree(rest, ignore_errors=True)  # of a writer that was killed
    scratch.mkdir()
    try:
        yield scratch
        if path.exists():
            path.rename(old)
        scratch.rename(path)
    finally:
        for rest in (scratch, old):
            shutil.rmtree(rest, ignore_errors=True)


def refuse_others(folder: str | Path, made: str = "", source: str | Path | None = None) -> None:
    """Raise InputError unless the folder that a user names for a product may be written.

    It may if it is not there, is empty, or has the file ``made`` of the command that writes it:
    then it is replaced. It must not lie in ``source``, the folder that the product is made of.
    """
    folder = Path(folder)
    if source is not None and folder.resolve().is_relative_to(Path(source).resolve()):
        raise InputError(f"lies in {source}", file=folder, remedy="name a folder beside it")
    if made and (folder / made).is_file():
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "is there already, and not empty", file=folder, remedy="name a folder that is not there"
        )


def link(source: Path, target: Path) -> None:
    """Hard link, or a copy where the file system has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        copy(source, target)


def copy(source: Path, target: Path) -> None:
    """A copy of a file in a folder that is made if it is not there."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def as_text(value: Any) -> Any:
    """A cell that no spreadsheet runs: texts get an apostrophe, numbers stay numbers."""
    if isinstance(value, str) and RUN.match(value):
        try:
            float(value)
        except ValueError:
            return MARK + value
    return value


def of_text(cell: str | None) -> str | None:
    """What :func:`as_text` was given."""
    marked = isinstance(cell, str) and cell.startswith(MARK) and RUN.match(cell)
    return cell[1:] if marked else cell


class TableWriter(csv.DictWriter):
    """Writes rows whose texts no spreadsheet takes for formulas."""

    def writerow(self, rowdict: Mapping[str, Any]) -> Any:
        """Write one row."""
        return super().writerow({key: as_text(value) for key, value in rowdict.items()})

    def writerows(self, rowdicts: Iterable[Mapping[str, Any]]) -> None:
        """Write several rows."""
        for row in rowdicts:
            self.writerow(row)


@contextmanager
def growing_table(
    path: str | Path, columns: Iterable[str], line_end: str = "\n"
) -> Iterator[TableWriter]:
    """A CSV file with its header, whole when the block ends well; its rows go to what is given."""
    with atomic_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as stream:
        writer = TableWriter(stream, list(columns), lineterminator=line_end)
        writer.writeheader()
        yield writer


def write_table(
    path: str | Path,
    rows: Iterable[Mapping[str, Any]],
    columns: Iterable[str] | None = None,
    line_end: str = "\n",
) -> None:
    """A CSV file, whole or absent; its columns are those of the first row, if none are given."""
    rows = list(rows)
    if columns is None:
        columns = rows[0] if rows else ()
    with growing_table(path, columns, line_end) as table:
        table.writerows(rows)


def read_table(path: str | Path) -> Iterator[dict[str, str]]:
    """Rows of a CSV file, one after the other. Raises FileNotFoundError if there is none."""
    with Path(path).open(newline="", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            yield {key: of_text(cell) for key, cell in row.items()}


def write_json(path: str | Path, values: Mapping[str, Any] | list[Any]) -> None:
    """A JSON file, whole or absent."""
    with atomic_file(path) as scratch:
        scratch.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: str | Path) -> dict[str, Any]:
    """What a product in JSON holds. Raises InputError if it is damaged."""
    try:
        found = json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        raise _damaged(path) from error
    if not isinstance(found, dict):
        raise _damaged(path)
    return found


def sealed(values: Mapping[str, Any]) -> str:
    """JSON with a digest of its own, by which :func:`read_sealed` knows that nothing changed."""
    text = {"digest": own_digest(values), **values}
    return json.dumps(text, indent=1, allow_nan=False) + "\n"


def write_sealed(values: Mapping[str, Any], path: str | Path) -> None:
    """A file of :func:`sealed`, whole or absent."""
    with atomic_file(path) as scratch:
        scratch.write_text(sealed(values), encoding="utf-8")


def read_sealed(path: str | Path) -> dict[str, Any]:
    """What :func:`sealed` was given. Raises InputError if it is not what was written."""
    values, is_as_written = read_perhaps_edited(path)
    if not is_as_written:
        raise _damaged(path, "not what was written")
    return values


def read_perhaps_edited(path: str | Path) -> tuple[dict[str, Any], bool]:
    """What a JSON file holds, and whether that is what :func:`sealed` was given."""
    values = read_json(path)
    return values, values.pop("digest", None) == own_digest(values)


def _damaged(path: str | Path, why: str = "no JSON of ours") -> InputError:
    remedy = "run the workflow again, which makes it again"
    return InputError(f"damaged: {why}", file=path, remedy=remedy)


def read_record(
    path: str | Path,
    make: Callable[[Any], Made],
    *,
    what: str,
    stage: str,
    read: Callable[[str | Path], dict[str, Any]] = read_sealed,
) -> Made:
    """What ``make`` makes of a file of :func:`sealed`, as ``read`` reads it.

    Raises InputError if that is missing or no ``what``; the ``stage`` makes it anew.
    """
    try:
        return make(read(path))
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"no such {what}", file=path, remedy=f"run the {stage} stage") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"no {what} ({error})", file=path, remedy=f"run the {stage} stage again"
        ) from error


def is_foreign(name: str) -> bool:
    """Whether a file of this name is one that another program has left."""
    return any(fnmatch(name.lower(), pattern) for pattern in FOREIGN)


def files_below(
    folder: str | Path, enter: Callable[[Path], bool] = lambda folder: True
) -> Iterator[Path]:
    """All files below a folder, by name, links followed, each folder once.

    ``enter``: which of its folders are gone into.
    """
    seen = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        state = Path(place).stat()
        if (state.st_dev, state.st_ino) in seen:  # a link to a folder above, or a second one
            folders.clear()
            continue
        seen.add((state.st_dev, state.st_ino))
        folders[:] = sorted(name for name in folders if enter(Path(place, name)))
        yield from (Path(place, name) for name in sorted(names))


def defect_of(name: object, longest: int = LONGEST_NAME) -> str:
    """Why a text is no plain name; empty if it is one."""
    if not isinstance(name, str) or not name:
        return "is empty"
    if len(name.encode("utf-8", "surrogateescape")) > longest:
        return f"is longer than {longest} bytes"
    if "/" in name or "\\" in name or name.startswith("."):
        return "leads to another folder, or to a hidden file"
    if not name.isprintable():
        return "has characters that cannot be printed"
    return ""


def plain_name(name: object, what: str, file: str | Path) -> str:
    """A name that ``file`` states. Raises InputError if it is no plain name.

    Plain: at most LONGEST_NAME bytes, printable, no ``/`` and no ``\\``, no dot at its beginning.
    """
    if defect := defect_of(name):
        raise InputError(
            f"{what} {shown(name)} {defect}",
            file=file,
            remedy=f"names have at most {LONGEST_NAME} characters, no / and no \\, and do not "
            "begin with a dot; who made the file may mean harm",
        )
    return str(name)


def path_below(path: object, what: str, file: str | Path) -> str:
    """A path that ``file`` states. Raises InputError if it leads out of the file's folder."""
    text = path if isinstance(path, str) else ""
    defects = [defect_of(part, longest=255) for part in text.split("/")]
    if len(text) > LONGEST_PATH:
        defects.append(f"is longer than {LONGEST_PATH} characters")
    if defect := next(filter(None, defects), ""):
        raise InputError(
            f"{what} {shown(path)} is no path below its folder: a part of it {defect}",
            file=file,
            remedy="paths are relative and name files below the folder; who made the file may mean "
            "harm",
        )
    return text


def shown(name: object) -> str:
    """A text in quotation marks, cut short, fit for one line of any terminal."""
    text = ascii(name)
    return text if len(text) <= 80 else f"{text[:70]}…{text[-1]}"
