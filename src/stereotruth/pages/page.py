"""Pages that stand alone: one HTML file with style, script and pictures, which asks for nothing.

All pages share ``base.html.jinja`` (frame, style, sorting of tables) and ``parts.html.jinja``
(tables, cards, charts). Equal input gives equal bytes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2

from ..core.products.files import atomic_file
from .tables import gate, minus, words

SHARED = Path(__file__).parent  # of what all pages share
INDEX = Path("results/report/index.html")  # of all pages of a folder
PAPER = "https://doi.org/10.1109/TGRS.2023.3245205"
FILTERS: Mapping[str, Callable[..., Any]] = {"words": words, "minus": minus, "gate": gate}


def write_page(out: str | Path, template: str | Path, values: Mapping[str, Any]) -> None:
    """Fill ``template`` (a file that extends ``base.html.jinja``) and write it to ``out``.

    ``values`` may name ``index``: the way from the page to the index of all pages.
    """
    template = Path(template)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, SHARED]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= FILTERS
    given = {"index": None, "paper": PAPER, **values}
    with atomic_file(out) as scratch, scratch.open("w", encoding="utf-8") as stream:
        environment.get_template(template.name).stream(given).dump(stream)


def way(page: str | Path, target: str | Path | None) -> str | None:
    """The relative address of a file or folder, as a link on a page; None of None."""
    if target is None:
        return None
    return Path(os.path.relpath(target, Path(page).parent)).as_posix()
