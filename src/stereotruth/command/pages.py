"""The pages that a project has."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError
from ..report.index_page import pages_of, write_index


def pages(words: Iterable[str] = ()) -> list[Path]:
    """Pages of this folder with one of the words in their path; without words all, the
    index of them first.

    Raises InputError if there is none.
    """
    words = list(words)
    index, found = write_index(), pages_of(Path())
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
