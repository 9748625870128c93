"""The pages that a project has."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError
from ..pages.page import INDEX
from ..report.index_page import pages_of, write_index


def pages(words: Iterable[str] = ()) -> list[Path]:
    """Pages of this folder with one of the words in their path; without words all, the
    index of them first.

    Raises InputError if there is none.
    """
    words = list(words)
    found = pages_of(Path())
    try:
        index = write_index()
    except OSError:  # a folder that is read-only: as its last run has left it
        index = INDEX if INDEX.is_file() else None
    chosen = [page for page in found if any(word in str(page) for word in words)]
    if not words and index:
        chosen = [index, *found]
    if not chosen:
        there = f"; there are {', '.join(map(str, found))}" if found else ""
        raise InputError(
            f"no page{' of ' + ', '.join(words) if words else ''}{there}",
            file=Path.cwd(),
            remedy="stereotruth run report makes the pages of all cities",
        )
    return chosen
