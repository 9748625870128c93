"""The page of a site, from its sheets and from what runs have made of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import sheets
from ..errors import InputError
from ..products.html_page import INDEX
from ..project import configured, names_in_pair, read_images, read_scenes, sheet
from ..report.index_page import write_index
from ..report.site_page import Pair, SiteImage, write_site_page
from .pairs import rated_pairs
from .site import OpenedImage, images_of


def write_page_of_site(city: str, configfiles: Sequence[Path] | None = None) -> Path:
    """Write ``results/site/<city>/index.html`` and the index of all pages; returns the former.

    Raises InputError if the city has no images, or a record of it is damaged.
    """
    settings, _ = configured(configfiles)
    _, scenes = read_scenes(settings)
    images = read_images(settings, sheets.read_cities(sheet(settings, "cities")))
    names = {frozenset(names_in_pair(scene, images)): name for name, scene in scenes.items()}
    pairs = [
        Pair(
            one.pair.left,
            one.pair.right,
            one.quality.matched,
            one.pair.convergence,
            one.pair.days,
            one.quality.reason,
            names.get(frozenset((one.pair.left, one.pair.right)), ""),
        )
        for one in rated_pairs(city, settings)
    ]
    out = Path("results", "site", city, "index.html")
    out.parent.mkdir(parents=True, exist_ok=True)
    page = Path("results", "report", city, "index.html")
    write_site_page(
        city,
        [_shown(one) for one in images_of(city, images, settings)],
        pairs,
        out,
        adjusted=_record(Path("results", "adjust", f"{city}.json")),
        closure=_record(Path("results", "closure", f"{city}.json")),
        page=page if page.is_file() else None,
        index=INDEX,
    )
    write_index()
    return out


def _shown(one: OpenedImage) -> SiteImage:
    """An image with its corners at the height of its RPC."""
    image = one.image
    cols, rows = image.size
    lon, lat = image.sensor.localize(
        np.array([0.0, cols - 1.0, cols - 1.0, 0.0]),
        np.array([0.0, 0.0, rows - 1.0, rows - 1.0]),
        float(image.sensor.rpc.height_off),
    )
    corners = [(float(x), float(y)) for x, y in zip(lon, lat)]
    return SiteImage(image.name, "" if image.time is None else f"{image.time:%Y-%m-%d}", corners)


def _record(file: Path) -> dict[str, Any]:
    """A JSON file's object; empty if there is no such file. Raises InputError if it is damaged."""
    if not file.is_file():
        return {}
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(
            "damaged: it is no JSON", file=file, remedy="delete it and run the workflow again"
        ) from None
