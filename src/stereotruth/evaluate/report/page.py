"""The page of a city: what was made, how good it is, and a look at every tile, in one file.

The page needs no network and no other file. Pictures lie in it as WebP, within ``PICTURE_BYTES``
in all: with many tiles, thumbnails get smaller and only some tiles have large pictures. A section
whose input is missing is left out. Equal input gives equal bytes.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.job import progress
from ...core.products.files import read_table
from ...core.status import Status
from ...pages.page import way, write_page
from ...pages.pictures import DISPARITIES, Scale, encode_file
from ...pages.tables import minus, missed, table
from ...tiles.manifest import NONE, SPLITS, read_manifest, tells_of_change
from ...tiles.orientation import PixelSize
from ...tiles.quick_looks import SPLIT_COLOURS, status_colours
from .city_pictures import (
    LARGE,
    NO_MATCH,
    TilePictures,
    disparity_counts,
    disparity_limits,
    histograms,
    tile_map,
    tile_pictures,
)
from .sections import (
    exact_truth,
    headlines,
    quality_gates,
    residuals,
    table4_beside_the_paper,
)

Place = str | Path
Row = Mapping[str, str]
Record = Mapping[str, Any]

PICTURE_BYTES = 24_000_000  # of all pictures as they stand in the page (base64)
BASE64 = 3 / 4  # bytes of a picture per byte in the page
SHARES = {"figures": 0.1, "thumbnails": 0.4, "sliders": 0.5}
MOST_BYTES = {"figures": 600_000, "thumbnails": 24_000, "sliders": 200_000}  # of each picture
COVERAGE_PX, FIGURE_PX, THUMBNAIL_PX, SLIDER_PX = 2200, 1400, 320, 900
SAME_HEIGHT = 1.1  # of a px of disparity: the largest of the scenes to the least
KINDS = ("left", "right", "disparity", "status")
TEMPLATE = Path(__file__).with_name("page.html.jinja")
CHANGED, MISFIT = Status.CHANGED.label, "changed_(does_not_fit_the_images)"
FILES = ("left", "right", "disp", "status", "orientation")  # columns of the manifest
FIRST = ("tile", "quality", "scene", "split", "class", "labelled_share")  # and these come first


@dataclass(frozen=True)
class CityFiles:
    """Files of a city; a section of the page is left out whose file is None or missing.

    ``tiles``: the exported tiles; ``summary``: what the last lines of a run say of them;
    ``coverage``: the coverage map (PNG); ``looks``: georeferenced pictures of the left images by
    scene; ``alignments``, ``refinements``: alignment.json by scene,
    after the fit to the GCPs and after refinement, with their figures (PNG) ``residual_figures``
    and ``refinement_figures``; ``truth``, ``truth_table``: truth.json and truth.csv; ``table4``,
    ``sift``: table4.csv and sift.csv with their ``sift_figure`` (PNG).
    """

    tiles: Place
    summary: Place | None = None
    coverage: Place | None = None
    looks: Mapping[str, Place] = field(default_factory=dict)
    alignments: Mapping[str, Place] = field(default_factory=dict)
    refinements: Mapping[str, Place] = field(default_factory=dict)
    residual_figures: Mapping[str, Place] = field(default_factory=dict)
    refinement_figures: Mapping[str, Place] = field(default_factory=dict)
    truth: Place | None = None
    truth_table: Place | None = None
    table4: Place | None = None
    sift: Place | None = None
    sift_figure: Place | None = None

    def links(self, page: Place) -> list[tuple[str, str, str]]:
        """Name, way from the page and meaning of what a reader may open, as far as it exists."""
        folder = Path(self.tiles)
        every = (
            (folder, "tiles", "left, right, disp, status, orientation"),
            (folder / "manifest.csv", "manifest.csv", "one row per tile"),
            (folder / "footprints.geojson", "footprints.geojson", "with a style for QGIS"),
            (folder / "export.json", "export.json", "figures, limits, parameters"),
            (self.truth_table, "truth.csv", "labels against the exact truth"),
            (self.table4, "table4.csv", "SIFT matches, as table 4 of the paper"),
            (self.sift, "sift.csv", "the same by scene and tile"),
        )
        return [
            (name, str(way(page, file)), text)
            for file, name, text in every
            if file is not None and Path(file).exists()
        ]


def write_report(
    city: str,
    files: CityFiles,
    out: Place,
    *,
    index: Place | None = None,
    sliders: int = 0,
    workers: int = 1,
    code: str = "",
) -> None:
    """Write the page of a city from its ``files``.

    ``index``: the page of all pages. ``sliders``: most tiles with large pictures.

    Raises InputError if there is no manifest.
    """
    folder = Path(files.tiles)
    rows = read_manifest(folder)
    labelled = [row for row in rows if row["complete"] == "yes"]
    export, truth = _record(folder / "export.json"), _record(files.truth)
    alignments, refined = (
        {scene: record for scene, file in of.items() if (record := _record(file))}
        for of in (files.alignments, files.refinements)
    )
    sizes = _pixel_sizes(folder, labelled)
    height = _common_height_m(sizes.values())
    since = {"since_last_run": _record(files.summary).get("since_last_run", {})}
    truth_rows = _rows(files.truth_table)
    figure_count = 2 + len(files.looks) + 2 * len(alignments)
    allowed = _allowance("figures", figure_count)

    def embedded(file: Place | None, side: int = FIGURE_PX) -> str | None:
        is_there = file is not None and Path(file).is_file()
        return encode_file(Path(file), allowed, side) if is_there else None

    made_of = {
        "tiles": export,
        **{f"alignment of {scene}": record for scene, record in alignments.items()},
        **{f"refinement of {scene}": record for scene, record in refined.items()},
        "comparison with the truth": truth,
        "this page": {"provenance": {"code": code, "sliders": sliders}},
    }
    looks = [Path(file) for file in files.looks.values() if Path(file).is_file()]
    values = {
        "city": city,
        "index": way(out, index),
        "headlines": headlines(rows, alignments, refined, truth_rows, export | since, height),
        "sizes": sizes,
        "heights_of_10_px": _heights_of_10_px(sizes.values()),
        "links": files.links(out),
        "provenance": provenance(made_of),
        "export": export,
        "coverage": embedded(files.coverage, COVERAGE_PX),
        "map": tile_map(folder, rows, looks, allowed),
        "residuals": [
            {
                "scene": scene,
                **(of_scene := residuals(record, refined.get(scene, {}))),
                "figures": [
                    (title, uri)
                    for title, of in (
                        (
                            "residuals of the control points",
                            files.residual_figures if of_scene["points"] else {},
                        ),
                        ("tie points before and after refinement", files.refinement_figures),
                    )
                    if (uri := embedded(of.get(scene)))
                ],
            }
            for scene, record in alignments.items()
        ],
        "table4": table4_beside_the_paper(_rows(files.table4)),
        "sift": table(_rows(files.sift)),
        "sift_figure": embedded(files.sift_figure),
        "truth": exact_truth(truth_rows, truth),
        "quality": quality_gates(export.get("quality", {})),
        **_of_tiles(city, folder, rows, sizes, sliders, workers),
    }
    write_page(out, TEMPLATE, values)


def _of_tiles(
    city: str,
    folder: Path,
    rows: Sequence[Row],
    sizes: Mapping[str, PixelSize],
    sliders: int,
    workers: int,
) -> dict[str, Any]:
    """The page's values about the tiles, with their pictures; large ones of ``sliders`` tiles."""
    labelled = [row["tile"] for row in rows if row["complete"] == "yes"]
    # evenly chosen, the first and the last included
    picked = np.linspace(0, len(labelled) - 1, min(sliders, len(labelled))).round().astype(int)
    large = {labelled[k] for k in picked}
    small = len(KINDS) * len(labelled) + 2 * (len(rows) - len(labelled))
    thumbnail = THUMBNAIL_PX, _allowance("thumbnails", small)
    big = SLIDER_PX, _allowance("sliders", len(LARGE) * len(large))
    with ThreadPoolExecutor(workers) as pool:
        counted = list(pool.map(lambda row: disparity_counts(folder, row), rows))
        limits = disparity_limits(counted)

        def draw(row: Row) -> TilePictures:
            size = sizes.get(row["scene"])
            return tile_pictures(
                folder,
                row,
                thumbnail=thumbnail,
                large=big if row["tile"] in large else None,
                limits_px=limits,
                base_to_height=size.base_to_height if size else 1.0,
            )

        drawn = list(progress(pool.map(draw, rows), len(rows), f"{city}: tiles drawn"))
    made = {row["tile"]: of for row, of in zip(rows, drawn)}
    spans = {name: np.ptp(of.disparity_px) for name, of in made.items() if of.layers}
    statuses = {row["tile"]: status_counts(row) for row in rows}
    every = sum((statuses[tile] for tile in labelled), Counter())

    def by(column: str, values: Iterable[str]) -> dict[str, Counter[int]]:
        return {
            value: sum((c for row, c in zip(rows, counted) if row[column] == value), Counter())
            for value in values
        }

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    return {
        "rows": rows,
        "scenes": scenes,
        "made": made,
        "first": max(spans, key=spans.__getitem__, default=None),
        "disparities": limits and Scale.of(DISPARITIES, *(minus(f"{v:.0f} px") for v in limits)),
        "missed": {row["tile"]: missed(row) for row in rows if missed(row)},
        "statuses": _shares(every),
        "status_colours": status_colours(list(every)) | {MISFIT: Status.CHANGED.colour},
        "shares": {tile: _shares(counts) for tile, counts in statuses.items()},
        "split_colours": SPLIT_COLOURS,
        "no_match": f"rgb{NO_MATCH}",
        "histograms": [
            chart
            for chart in (
                histograms("disparities by split", by("split", (*SPLITS, NONE))),
                histograms("disparities by scene", by("scene", scenes)) if scenes[1:] else None,
            )
            if chart
        ],
        "manifest": table(
            rows,
            manifest_columns(rows),
            {"tile": {row["tile"]: f"#tile-{row['tile']}" for row in rows}},
        ),
        "large_count": len(large),
        "few_large": len(large) < len(labelled),
    }


def _allowance(share: str, count: int) -> int:
    """Bytes of each of ``count`` pictures of a kind."""
    return min(MOST_BYTES[share], int(PICTURE_BYTES * BASE64 * SHARES[share] / max(count, 1)))


def _rows(path: Place | None) -> list[dict[str, str]]:
    """Rows of a CSV file; none if there is no such file."""
    return list(read_table(path)) if path is not None and Path(path).is_file() else []


def _record(path: Place | None) -> dict[str, Any]:
    """A JSON file's object; empty if there is no such file. Raises InputError if it is damaged."""
    if path is None or not Path(path).is_file():
        return {}
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(
            "damaged: it is no JSON", file=path, remedy="delete it and run the workflow again"
        ) from None


def _pixel_sizes(folder: Path, labelled: Sequence[Row]) -> dict[str, PixelSize]:
    """What a pixel is in metres, by scene, of some of the tiles."""
    found = {}
    for scene in dict.fromkeys(row["scene"] for row in labelled):
        here = [row for row in labelled if row["scene"] == scene and row.get("orientation")]
        if size := PixelSize.mean([folder / row["orientation"] for row in here[:20:4]]):
            found[scene] = size
    return found


def _common_height_m(sizes: Iterable[PixelSize]) -> float | None:
    """Height in m of a px of disparity, the largest, where scenes have about the same."""
    heights = sorted(size.height_m for size in sizes)
    return heights[-1] if heights and heights[-1] < SAME_HEIGHT * heights[0] else None


def _heights_of_10_px(sizes: Iterable[PixelSize]) -> str:
    """Height in m that 10 px of disparity are: one figure, or the least and greatest of scenes."""
    texts = [f"{10 * height:.1f}" for height in sorted(size.height_m for size in sizes)]
    return " … ".join(dict.fromkeys(texts[:1] + texts[-1:]))


def status_counts(row: Row) -> Counter[str]:
    """Pixels of a tile by status; what is `changed` where nothing tells of a change, as MISFIT."""
    told, start = tells_of_change(row), "count_"
    counts = ((n.removeprefix(start), v) for n, v in row.items() if n.startswith(start) and v)
    return Counter({MISFIT if n == CHANGED and not told else n: int(v) for n, v in counts})


def _shares(counts: Counter[str]) -> dict[str, float]:
    return {name: count / counts.total() for name, count in counts.items() if count}


def provenance(records: Mapping[str, Record]) -> list[dict[str, Any]]:
    """Per product: software and code, parameters, inputs, as (name, value)."""

    def flat(values: Record, prefix: str = "") -> list[tuple[str, str]]:
        pairs = []
        for key, value in values.items():
            if isinstance(value, Mapping):
                pairs += flat(value, f"{prefix}{key}.")
            else:
                text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
                pairs.append((f"{prefix}{key}", text))
        return pairs

    return [
        {"product": product, "values": flat(record["provenance"])}
        for product, record in records.items()
        if record.get("provenance")
    ]


def manifest_columns(rows: Sequence[Row]) -> list[str]:
    """Columns that differ between tiles, without files and checksums; ``FIRST`` first."""
    names = [
        name
        for name in rows[0]
        if name not in (*FILES, "number")
        and not name.endswith("_sha256")
        and (name in ("tile", "scene", "split", "quality") or len({r[name] for r in rows}) > 1)
    ]
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
