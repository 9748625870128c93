"""The page of a city: what was made, how good it is, and a look at every tile, in one file.

The page needs no network and no other file. Pictures lie in it as WebP, within ``PICTURE_BYTES``
in all: with many tiles, thumbnails get smaller and only some tiles have large pictures. A section
whose input is missing is left out. Equal input gives equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset import quick_looks
from ..dataset.manifest import read_manifest
from ..dataset.pixel_size import PixelSize
from ..errors import InputError
from ..job import progress
from ..products import pictures
from ..products.files import read_table
from ..products.html_page import way, write_page
from ..products.html_tables import missed, table
from . import drawings, sections, tile_pictures
from .ground_map import ground_map
from .headlines import headlines
from .settings import Settings

PICTURE_BYTES = 24_000_000  # of all pictures as they stand in the page (base64)
BASE64 = 3 / 4  # bytes of a picture per byte in the page
SHARES = {"figures": 0.1, "thumbnails": 0.4, "sliders": 0.5}
COVERAGE_PX, FIGURE_PX, THUMBNAIL_PX, SLIDER_PX = 2200, 1400, 320, 900
# At most, however few there are:
FIGURE_BYTES, THUMBNAIL_BYTES, SLIDER_BYTES = 600_000, 24_000, 200_000
KINDS = ("left", "right", "disparity", "status")
TEMPLATE = Path(__file__).with_name("page.html.jinja")
LARGE = ("slider_left", "slider_warped", "slider_difference", "slider_disparity")


def _rows(path: str | Path | None) -> list[dict[str, str]]:
    """Rows of a CSV file; none if there is no such file."""
    if path is None or not Path(path).is_file():
        return []
    return list(read_table(path))


def _record(path: str | Path | None) -> dict[str, Any]:
    """A JSON file's object; empty if there is no such file. Raises InputError if it is damaged."""
    if path is None or not Path(path).is_file():
        return {}
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(
            "damaged: it is no JSON", file=path, remedy="delete it and run the workflow again"
        ) from None


def _chosen(names: Sequence[str], most: int) -> set[str]:
    """At most so many of the names, evenly chosen, the first and the last included."""
    if len(names) <= most:
        return set(names)
    picked = np.linspace(0, len(names) - 1, most).round().astype(int) if most else []
    return {names[k] for k in picked}


def _allowance(share: str, count: int, most: int) -> int:
    """Bytes of each of ``count`` pictures of a kind."""
    return min(most, int(PICTURE_BYTES * BASE64 * SHARES[share] / max(count, 1)))


def _files(
    page: str | Path,
    tiles: Path,
    truth: str | Path | None,
    table4: str | Path | None,
    sift: str | Path | None,
) -> list[tuple[str, str, str]]:
    """Name, way and meaning of the files that the page is made of, those that are there."""
    every = (
        (tiles, "tiles", "left, right, disp, status, orientation"),
        (tiles / "manifest.csv", "manifest.csv", "one row per tile"),
        (tiles / "footprints.geojson", "footprints.geojson", "with a style for QGIS"),
        (tiles / "export.json", "export.json", "figures, limits, parameters"),
        (truth, "truth.csv", "labels against the exact truth"),
        (table4, "table4.csv", "SIFT matches, as table 4 of the paper"),
        (sift, "sift.csv", "the same by scene and tile"),
    )
    return [
        (name, str(way(page, file)), text)
        for file, name, text in every
        if file is not None and Path(file).exists()
    ]


def write_report(
    city: str,
    tiles: str | Path,
    out: str | Path,
    *,
    index: str | Path | None = None,
    coverage: str | Path | None = None,
    looks: Mapping[str, str | Path] | None = None,
    alignments: Mapping[str, str | Path] | None = None,
    refinements: Mapping[str, str | Path] | None = None,
    refinement_figures: Mapping[str, str | Path] | None = None,
    truth: str | Path | None = None,
    truth_table: str | Path | None = None,
    table4: str | Path | None = None,
    sift: str | Path | None = None,
    sift_figure: str | Path | None = None,
    sliders: int = Settings.sliders,
    workers: int = 1,
    code: str = "",
) -> None:
    """Write the page of a city from its exported ``tiles``.

    ``index``: the page of all pages; ``coverage`` is the coverage map (PNG); ``looks``:
    georeferenced pictures of the left images by scene; ``alignments``, ``refinements``:
    alignment.json by scene, after the fit to the GCPs and after refinement;
    ``refinement_figures``: refinement.png by scene; ``truth``, ``truth_table``: truth.json and
    truth.csv; ``table4``, ``sift``: table4.csv and sift.csv with their ``sift_figure`` (PNG).
    ``sliders``: most tiles with large pictures.
    Whatever is None or missing leaves its section out.

    Raises InputError if there is no manifest.
    """
    folder = Path(tiles)
    rows = read_manifest(folder)
    records = {scene: _record(file) for scene, file in (alignments or {}).items()}
    records = {scene: record for scene, record in records.items() if record}
    refined = {scene: _record(file) for scene, file in (refinements or {}).items()}
    refined = {scene: record for scene, record in refined.items() if record}
    truth_rows, truth_record = _rows(truth_table), _record(truth)
    export = _record(folder / "export.json")
    quality = export.get("quality", {})

    labelled = [row["tile"] for row in rows if row["complete"] == "yes"]
    large = _chosen(labelled, sliders)
    thumbnail = (
        THUMBNAIL_PX,
        _allowance(
            "thumbnails",
            len(KINDS) * len(labelled) + 2 * (len(rows) - len(labelled)),
            THUMBNAIL_BYTES,
        ),
    )
    slider = (SLIDER_PX, _allowance("sliders", len(LARGE) * len(large), SLIDER_BYTES))

    def work(row: Mapping[str, str]) -> tile_pictures.TilePictures:
        return tile_pictures.tile_pictures(
            folder, row, thumbnail=thumbnail, slider=slider if row["tile"] in large else None
        )

    with ThreadPoolExecutor(workers) as pool:
        drawn = list(progress(pool.map(work, rows), len(rows), f"{city}: tiles drawn"))
    made = {row["tile"]: of for row, of in zip(rows, drawn)}
    statuses = [name.removeprefix("count_") for name in rows[0] if name.startswith("count_")]
    total = {name: 0.0 for name in statuses}
    for row in rows:
        if row["complete"] == "yes":
            for name, share in sections.status_shares(row).items():
                total[name] += share / len(labelled)

    looks = {scene: Path(file) for scene, file in (looks or {}).items() if Path(file).is_file()}
    orientations = {
        scene: [
            folder / row["orientation"]
            for row in rows
            if row["scene"] == scene and row["complete"] == "yes" and row.get("orientation")
        ]
        for scene in dict.fromkeys(row["scene"] for row in rows)
    }
    sizes = {
        scene: size for scene, of in orientations.items() if (size := PixelSize.mean(of[:20:4]))
    }
    height = max((size.height_m for size in sizes.values()), default=None)
    wide = [coverage, *looks.values(), sift_figure, *(refinement_figures or {}).values()]
    allowed = _allowance("figures", len(wide), FIGURE_BYTES)

    def embedded(file: str | Path | None, side: int) -> str | None:
        if file is None or not Path(file).is_file():
            return None
        return pictures.encode_file(Path(file), allowed, side)

    values = {
        "city": city,
        "index": way(out, index),
        "headlines": headlines(rows, records, refined, truth_rows, quality, height),
        "sizes": sizes,
        "height_m_per_px": height,
        "links": _files(out, folder, truth_table, table4, sift),
        "rows": rows,
        "made": made,
        "missed": {row["tile"]: missed(row) for row in rows if missed(row)},
        "shares": {row["tile"]: sections.status_shares(row) for row in rows},
        "total": total,
        "status_colours": tile_pictures.status_colours(statuses),
        "split_colours": quick_looks.SPLIT_COLOURS,
        "disparities": pictures.gradient(pictures.DISPARITIES),
        "diverging": pictures.gradient(pictures.DIFFERENCES),
        "no_match": f"rgb{tile_pictures.NO_MATCH}",
        "no_difference": f"rgb{tile_pictures.NO_DIFFERENCE}",
        "coverage": embedded(coverage, COVERAGE_PX),
        "windows": sections.tile_index(rows),
        "ground": ground_map(folder, rows, looks.values(), allowed),
        "residuals": sections.residuals(
            records,
            refined,
            {
                scene: embedded(file, FIGURE_PX)
                for scene, file in (refinement_figures or {}).items()
            },
        ),
        "histograms": sections.histograms(rows, made),
        "histogram_size": (drawings.WIDTH, drawings.HEIGHT),
        "manifest": table(rows, sections.manifest_columns(rows)),
        "table4": sections.table4_beside_the_paper(_rows(table4)),
        "sift": table(_rows(sift)),
        "sift_figure": embedded(sift_figure, FIGURE_PX),
        "truth": sections.exact_truth(truth_rows, truth_record),
        "quality": sections.quality_gates(quality),
        "provenance": sections.provenance(
            {
                "tiles": export,
                **{f"alignment of {scene}": record for scene, record in records.items()},
                **{f"refinement of {scene}": record for scene, record in refined.items()},
                "comparison with the truth": truth_record,
                "this page": {"provenance": {"code": code, "sliders": sliders}},
            }
        ),
        "export": export,
        "few_large": len(large) < len(labelled),
        "large_count": len(large),
    }
    write_page(out, TEMPLATE, values)
