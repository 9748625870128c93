"""The page of a city: what was made, how good it is, and a look at every tile, in one file.

The page needs no network and no other file. Pictures lie in it as WebP, within ``PICTURE_BYTES``
in all: with many tiles, thumbnails get smaller and only some tiles have large pictures. A section
whose input is missing is left out. Equal input gives equal bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset import quick_looks
from ..dataset.pixel_size import PixelSize
from ..job import progress
from ..products import pictures
from ..products.html_page import way, write_page
from ..products.html_tables import missed, table
from . import sections, tile_pictures
from .city_files import CityFiles, CityRecords, rows_of
from .ground_map import ground_map
from .headlines import headlines

PICTURE_BYTES = 24_000_000  # of all pictures as they stand in the page (base64)
BASE64 = 3 / 4  # bytes of a picture per byte in the page
SHARES = {"figures": 0.1, "thumbnails": 0.38, "sliders": 0.48, "reliefs": 0.04}
COVERAGE_PX, FIGURE_PX, THUMBNAIL_PX, SLIDER_PX = 2200, 1400, 320, 900
# At most, however few there are:
FIGURE_BYTES, THUMBNAIL_BYTES, SLIDER_BYTES, RELIEF_BYTES = 600_000, 24_000, 200_000, 192**2
KINDS = ("left", "right", "disparity", "status")
TEMPLATE = Path(__file__).with_name("page.html.jinja")
LARGE = ("left", "warped", "difference", "disparity", "hillshade")


def _chosen(names: Sequence[str], most: int) -> set[str]:
    """At most so many of the names, evenly chosen, the first and the last included."""
    if len(names) <= most:
        return set(names)
    picked = np.linspace(0, len(names) - 1, most).round().astype(int) if most else []
    return {names[k] for k in picked}


def _allowance(share: str, count: int, most: int) -> int:
    """Bytes of each of ``count`` pictures of a kind."""
    return min(most, int(PICTURE_BYTES * BASE64 * SHARES[share] / max(count, 1)))


@dataclass(frozen=True)
class _Tiles:
    """The tiles as they were drawn, by name, and their labels by whole px.

    ``large``: those with large pictures; ``first``: the one of these on top of the page;
    ``limits_px``: of the colours of disparity.
    """

    made: dict[str, tile_pictures.TilePictures]
    counts: dict[str, Mapping[int, int]]
    large: set[str]
    limits_px: tuple[float, float] | None

    @classmethod
    def drawn(
        cls,
        city: str,
        files: CityFiles,
        records: CityRecords,
        sizes: Mapping[str, PixelSize],
        sliders: int,
        workers: int,
    ) -> _Tiles:
        """Draw the pictures of all tiles, large ones of ``sliders`` of them."""
        rows = records.rows
        labelled = [row["tile"] for row in records.labelled]
        large = _chosen(labelled, sliders)
        small = len(KINDS) * len(labelled) + 2 * (len(rows) - len(labelled))
        thumbnail = (THUMBNAIL_PX, _allowance("thumbnails", small, THUMBNAIL_BYTES))
        big = tile_pictures.Large(
            SLIDER_PX,
            _allowance("sliders", len(LARGE) * len(large), SLIDER_BYTES),
            int(math.sqrt(_allowance("reliefs", len(large), RELIEF_BYTES))),
        )
        with ThreadPoolExecutor(workers) as pool:
            counted = list(
                pool.map(lambda row: tile_pictures.disparity_counts(files.folder, row), rows)
            )
            limits = tile_pictures.disparity_limits(counted)

            def work(row: Mapping[str, str]) -> tile_pictures.TilePictures:
                size = sizes.get(row["scene"])
                return tile_pictures.tile_pictures(
                    files.folder,
                    row,
                    thumbnail=thumbnail,
                    large=big if row["tile"] in large else None,
                    limits_px=limits,
                    base_to_height=size.base_to_height if size else 1.0,
                )

            drawn = list(progress(pool.map(work, rows), len(rows), f"{city}: tiles drawn"))
        names = [row["tile"] for row in rows]
        return cls(dict(zip(names, drawn)), dict(zip(names, counted)), large, limits)

    @property
    def first(self) -> str | None:
        """Of the tiles with large pictures the one whose labels span most; None of none."""
        spans = {
            name: np.ptp(of.disparity_px)
            for name, of in self.made.items()
            if of.relief is not None and of.disparity_px is not None
        }
        return max(spans, key=lambda name: spans[name], default=None)


@dataclass(frozen=True)
class _Figures:
    """Figures of a city, each with ``allowed`` bytes in the page."""

    files: CityFiles
    allowed: int

    @classmethod
    def of(cls, files: CityFiles) -> _Figures:
        """Those of the files, which share the bytes of all figures."""
        wide = [files.coverage, *files.looks_there_are, files.sift_figure]
        count = len(wide) + len(files.refinement_figures)
        return cls(files, _allowance("figures", count, FIGURE_BYTES))

    def embedded(self, file: str | Path | None, side: int) -> str | None:
        """A picture of at most ``side`` px as it stands in the page; None if there is no file."""
        if file is None or not Path(file).is_file():
            return None
        return pictures.encode_file(Path(file), self.allowed, side)

    @property
    def of_refinements(self) -> dict[str, str | None]:
        """By scene."""
        return {
            scene: self.embedded(file, FIGURE_PX)
            for scene, file in self.files.refinement_figures.items()
        }


def _pixel_sizes(folder: Path, labelled: Sequence[Mapping[str, str]]) -> dict[str, PixelSize]:
    """What a pixel is in metres, by scene, of some of the tiles."""
    found = {}
    for scene in dict.fromkeys(row["scene"] for row in labelled):
        of = [
            folder / row["orientation"]
            for row in labelled
            if row["scene"] == scene and row.get("orientation")
        ]
        if size := PixelSize.mean(of[:20:4]):
            found[scene] = size
    return found


def _status_total(records: CityRecords) -> dict[str, float]:
    """Share of the labelled tiles' pixels by status."""
    names = [name.removeprefix("count_") for name in records.rows[0] if name.startswith("count_")]
    total = {name: 0.0 for name in names}
    for row in records.labelled:
        for name, share in sections.status_shares(row).items():
            total[name] += share / len(records.labelled)
    return total


def _of_tiles(records: CityRecords, tiles: _Tiles) -> dict[str, Any]:
    """The page's values that are about the tiles."""
    rows, total = records.rows, _status_total(records)
    return {
        "rows": rows,
        "made": tiles.made,
        "first": tiles.first,
        "limits_px": tiles.limits_px,
        "missed": {row["tile"]: missed(row) for row in rows if missed(row)},
        "shares": {row["tile"]: sections.status_shares(row) for row in rows},
        "total": total,
        "status_colours": tile_pictures.status_colours(list(total)),
        "split_colours": quick_looks.SPLIT_COLOURS,
        "disparities": pictures.gradient(pictures.DISPARITIES),
        "diverging": pictures.gradient(pictures.DIFFERENCES),
        "no_match": f"rgb{tile_pictures.NO_MATCH}",
        "no_difference": f"rgb{tile_pictures.NO_DIFFERENCE}",
        "windows": sections.tile_index(rows),
        "histograms": sections.histograms(rows, tiles.counts),
        "manifest": table(rows, sections.manifest_columns(rows)),
        "few_large": len(tiles.large) < len(records.labelled),
        "large_count": len(tiles.large),
    }


def _of_files(files: CityFiles, records: CityRecords, figures: _Figures) -> dict[str, Any]:
    """The page's values that are about alignments, matches, truth and limits."""
    looks = files.looks_there_are
    return {
        "coverage": figures.embedded(files.coverage, COVERAGE_PX),
        "ground": ground_map(files.folder, records.rows, looks, figures.allowed),
        "residuals": sections.residuals(
            records.alignments, records.refinements, figures.of_refinements
        ),
        "table4": sections.table4_beside_the_paper(rows_of(files.table4)),
        "sift": table(rows_of(files.sift)),
        "sift_figure": figures.embedded(files.sift_figure, FIGURE_PX),
        "truth": sections.exact_truth(records.truth_rows, records.truth),
        "quality": sections.quality_gates(records.quality),
        "export": records.export,
    }


def write_report(
    city: str,
    files: CityFiles,
    out: str | Path,
    *,
    index: str | Path | None = None,
    sliders: int = 0,
    workers: int = 1,
    code: str = "",
) -> None:
    """Write the page of a city from its ``files``.

    ``index``: the page of all pages. ``sliders``: most tiles with large pictures.

    Raises InputError if there is no manifest.
    """
    records = CityRecords.of(files)
    sizes = _pixel_sizes(files.folder, records.labelled)
    tiles = _Tiles.drawn(city, files, records, sizes, sliders, workers)
    height = max((size.height_m for size in sizes.values()), default=None)
    made_of = {
        "tiles": records.export,
        **{f"alignment of {scene}": record for scene, record in records.alignments.items()},
        **{f"refinement of {scene}": record for scene, record in records.refinements.items()},
        "comparison with the truth": records.truth,
        "this page": {"provenance": {"code": code, "sliders": sliders}},
    }
    values = {
        "city": city,
        "index": way(out, index),
        "headlines": headlines(
            records.rows,
            records.alignments,
            records.refinements,
            records.truth_rows,
            records.quality,
            height,
        ),
        "sizes": sizes,
        "height_m_per_px": height,
        "links": files.links(out),
        "provenance": sections.provenance(made_of),
    }
    values |= _of_tiles(records, tiles)
    values |= _of_files(files, records, _Figures.of(files))
    write_page(out, TEMPLATE, values)
