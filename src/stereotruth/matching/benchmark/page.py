"""The page of a benchmark: the tables, figure 10 and pictures of tiles, in one file.

Like a city's page, it needs no network and no other file; equal input gives equal bytes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from ...products.files import replacing
from ...products.pictures import encode_file
from .score_method import describe
from .tables import Table

FIGURE_PX, FIGURE_BYTES = 2600, 3_000_000
PANEL_PX, PANELS_BYTES = 2000, 12_000_000  # the latter of all together


def write_page(
    out: str | Path,
    dataset: str,
    methods: Sequence[Mapping[str, Any]],
    tables: Sequence[Table],
    figure: str | Path | None,
    panels: Mapping[str, Sequence[Path]],
    curves: str | Path | None = None,
) -> None:
    """Write the page of a dataset.

    ``methods``: their summaries; ``figure``: figure 10; ``panels``: pictures of tiles by the
    method's label; ``curves``: the sparsification curves.
    """
    count = sum(map(len, panels.values()))
    allowed = min(400_000, PANELS_BYTES // max(count, 1))
    values = {
        "dataset": dataset,
        "headlines": [(of["label"], describe(of)) for of in methods],
        "settings": [(of["label"], _settings(of)) for of in methods],
        "tables": tables,
        "figure": None if figure is None else encode_file(Path(figure), FIGURE_BYTES, FIGURE_PX),
        "curves": None if curves is None else encode_file(Path(curves), FIGURE_BYTES, FIGURE_PX),
        "panels": {
            label: [(file.stem, encode_file(file, allowed, PANEL_PX)) for file in files]
            for label, files in panels.items()
        },
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["plain"] = _plain
    with replacing(out) as scratch, scratch.open("w", encoding="utf-8") as stream:
        environment.get_template("page.html.jinja").stream(values).dump(stream)


def _plain(text: str) -> str:
    """A cell of Markdown without marks, with true minus signs."""
    return re.sub(r"(?<!\w)-(?=\d)", "−", text.replace("**", ""))


def _settings(of: Mapping[str, Any]) -> str:
    settings = ", ".join(f"{key} {value}" for key, value in of["settings"].items())
    machine = f"; {of['device']}, {of['threads']} threads" if of["device"] else ""
    return f"{settings}{machine}"
