"""Files and folders that are whole or absent."""

from __future__ import annotations

import csv
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .locks import exclusive


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A scratch file beside ``path``, of its suffix, that takes its place if the block ends well.

    The folder is made. If the block fails, the scratch file goes and ``path`` stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.stem}.partial{path.suffix}")
    with exclusive(path):
        try:
            yield scratch
            scratch.replace(path)
        finally:
            scratch.unlink(missing_ok=True)


def link(source: Path, target: Path) -> None:
    """Hard link, or a copy where the file system has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def write_rows(path: str | Path, columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """A CSV file, whole or absent."""
    with replacing(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_json(path: str | Path, values: Mapping[str, Any]) -> None:
    """A JSON file, whole or absent."""
    with replacing(path) as scratch:
        scratch.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")
