"""The pages that a project has."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError

PAGES = (
    "results/report/*/index.html",
    "benchmark/*/index.html",
    "audit/*/index.html",
    "score_dsm/*/*/*/index.html",
)


def pages(words: Iterable[str] = ()) -> list[Path]:
    """Pages of this folder with one of the words in their path, all without words, sorted.

    Raises InputError if there is none.
    """
    words = list(words)
    found = sorted(page for pattern in PAGES for page in Path().glob(pattern))
    chosen = [page for page in found if not words or any(word in str(page) for word in words)]
    if not chosen:
        there = f"; there are {', '.join(map(str, found))}" if found else ""
        raise InputError(
            f"no page{' of ' + ', '.join(words) if words else ''}{there}",
            file=Path.cwd(),
            remedy="stereotruth run report makes the pages of all cities",
        )
    return chosen
