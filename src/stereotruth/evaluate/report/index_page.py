"""The index of a folder's pages: cities, benchmarks, audits, surface models, with their figures.

It lists what is there, and no plan of a run knows that beforehand. Each job that makes a page
writes the index before it ends, and so do each run and whoever opens it: what is recorded as made
is in it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.products.making import exclusive
from ...core.status import carries_label
from ...pages.page import INDEX, way, write_page
from ...pages.tables import EMPTY, Cell, Column, Headline, Table, link_cell, spread, value_cell
from ...tiles.manifest import SPLITS, read_manifest

PAGES = (
    "results/report/*/index.html",
    "benchmark/*/index.html",
    "audit/*/index.html",
    "score_dsm/*/*/*/index.html",
    "results/site/*/index.html",
)
TEMPLATE = Path(__file__).with_name("index.html.jinja")
LOOK_PX, LOOK_BYTES = 260, 16_000  # of a thumbnail

CITY_COLUMNS = (
    "city", "left image, disparity", "pairs", "size, px", "labelled", "known to, px (median)",
    "for 95 %, px", "train", "val", "test", "error to truth, px", "SIFT − label, px",
    "beyond a limit", "files",
)  # fmt: skip


def pages_of(root: Path) -> list[Path]:
    """All pages below a folder but the index, sorted."""
    return sorted(page for pattern in PAGES for page in root.glob(pattern))


def pages_with(words: Sequence[str]) -> list[Path]:
    """Pages of this folder with one of the words in their path; without words all, the
    index of them first.

    Raises InputError if there is none.
    """
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


def write_index(root: Path = Path()) -> Path | None:
    """Write the index of the pages in a folder; None if there are none, and no index then.

    Raises InputError if what it shows of a page cannot be read.
    """
    out = root / INDEX
    if not pages_of(root):
        out.unlink(missing_ok=True)
        return None
    out.parent.mkdir(parents=True, exist_ok=True)
    with exclusive(out.with_name("pages")):  # other jobs' pages are in it, or are so later
        _write(root, out)
    return out


def _write(root: Path, out: Path) -> None:
    exports = {
        page: _read(root / "tiles" / page.parent.name / "export.json")
        for page in sorted(root.glob(PAGES[0]))
    }
    values = {
        "headlines": _totals(list(exports.values())),
        "cities": Table.of(
            CITY_COLUMNS,
            [_city(root, out, page, export) for page, export in exports.items()],
            words=(0, 1, len(CITY_COLUMNS) - 1),
        ),
        "benchmarks": _benchmarks(root, out),
        "audits": _audits(root, out),
        "surface_models": _surface_models(root, out),
        "sites": [
            (page.parent.name, str(way(out, page)), "images and pairs")
            for page in sorted(root.glob(PAGES[4]))
        ],
        "links": [
            (name, str(way(out, root / name)), text)
            for name, text in (
                ("dataset", "all cities in the published layout"),
                ("dataset/manifest.csv", "one row per pair"),
                ("tiles", "tiles by city"),
            )
            if (root / name).exists()
        ],
    }
    write_page(out, TEMPLATE, values)


def _read(file: Path) -> dict[str, Any]:
    """What a record holds; nothing if it is missing or damaged: the page says what there is."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _labelled(export: Mapping[str, Any]) -> float:
    """Share of the pixels of a city's labelled pairs that have a label."""
    return sum(share for name, share in export["share_of_pixels"].items() if carries_label(name))


def _totals(exports: list[dict[str, Any]]) -> list[Headline]:
    """All cities together."""
    made = [of for of in exports if of]
    if not made:
        return []
    pairs = sum(of["labelled_pairs"] for of in made)
    pixels = [of["labelled_pairs"] * of["size_px"] ** 2 for of in made]
    labels = sum(n * _labelled(of) for n, of in zip(pixels, made))
    by = {split: sum(of["splits"]["realised"].get(split, 0) for of in made) for split in SPLITS}
    medians = [
        total["uncertainty_median_px"]
        for of in made
        if (total := of.get("label_uncertainty", {}).get("all"))
    ]
    known = [Headline("labels known to", f"{spread(medians, '.2g')} px", "median of a city")]
    return [
        *(known if medians else ()),
        Headline(
            "labelled pairs",
            str(pairs),
            "of 1 city" if len(made) == 1 else f"of {len(made)} cities",
        ),
        Headline("labels", f"{labels / 1e6:.1f} million", f"{100 * labels / sum(pixels):.1f} %"),
        Headline("train, val, test", ", ".join(str(n) for n in by.values()), "pairs"),
    ]


def _city(root: Path, out: Path, page: Path, export: Mapping[str, Any]) -> tuple[Cell, ...]:
    """A row of the table of cities; figures are those of ``export.json``."""
    name = page.parent.name
    tiles = root / "tiles" / name
    link = way(out, page)
    if not export:
        return (link_cell(name, link), *[EMPTY] * (len(CITY_COLUMNS) - 1))
    truth = _read(root / "results" / "evaluate" / name / "truth.json")
    errors = truth["exported_tiles"]["errors"] if truth else {}
    scenes = export.get("quality", {}).get("scenes", {}).values()
    sift = [v for of in scenes if (v := of["sift_mean_absolute_error_px"]) is not None]
    known = export.get("label_uncertainty", {}).get("all", {})
    flagged = len(export.get("quality", {}).get("flagged_tiles", {}))
    splits = export.get("splits", {}).get("realised", {})
    manifest = tiles / "manifest.csv"
    return (
        link_cell(name, link),
        Cell("where the tiles are", "", href=str(link), pictures=_look(tiles)),
        value_cell(export["labelled_pairs"], "d"),
        value_cell(export["size_px"], "d"),
        value_cell(_labelled(export), ".1f", 100, " %"),
        value_cell(known.get("uncertainty_median_px"), ".2g"),
        value_cell(known.get("uncertainty_p95_px"), ".2g"),
        *(value_cell(splits.get(split, 0), "d") for split in SPLITS),
        value_cell(errors["mean_absolute"] if errors.get("count") else None, ".3f"),
        Cell(spread(sift, ".2f"), f"{max(sift):.6g}" if sift else ""),
        value_cell(flagged, "d", bad=flagged > 0),
        link_cell("manifest.csv", way(out, manifest)) if manifest.is_file() else EMPTY,
    )


def _look(tiles: Path) -> tuple[str, ...]:
    """Left image and disparity of the tile of a city whose labels span most; none if damaged."""
    from ...core.products.rasters import read_image, read_tile  # a second, where no page is
    from ...pages.pictures import colours, encode, shrink, stretch

    try:
        rows = [row for row in read_manifest(tiles) if row.get("complete") == "yes"]
        row = max(rows, key=lambda r: float(r["disparity_max_px"]) - float(r["disparity_min_px"]))
        grey = stretch(read_image(tiles / row["left"]))
        disparity = read_tile(tiles / row["disp"])
    except (InputError, OSError, ValueError, KeyError):
        return ()
    step = max(1, disparity.shape[0] // (2 * LOOK_PX))
    return tuple(
        encode(shrink(np.ascontiguousarray(of[::step, ::step]), LOOK_PX), LOOK_BYTES)
        for of in (grey, colours(disparity))
    )


def _benchmarks(root: Path, out: Path) -> Table | None:
    """A row per method that is scored, under its dataset."""
    groups = []
    for folder in sorted(root.glob("benchmark/*/")):
        page = folder / "index.html"
        scored = [(file, _read(file)) for file in sorted(folder.glob("*/scores.json"))]
        epe = [of["all"]["filled_epe_px"] for _, of in scored]
        scored = [scored[k] for k in np.argsort(np.array(epe, float), kind="stable")]  # None last
        lines = tuple(
            (
                link_cell(folder.name, way(out, page) if page.is_file() else None),
                link_cell(of["label"], way(out, file.parent / "cities.csv")),
                value_cell(of["all"]["filled_epe_px"], ".3f", unit=" px"),
                value_cell(
                    of["all"][f"filled_d1_{of['thresholds_px'][0]:g}_px_share"],
                    ".2f", 100, f" % (> {of['thresholds_px'][0]:g} px)",
                ),
                value_cell(of["all"]["valid_share"], ".1f", 100, " %"),
                value_cell(of["tiles"], "d"),
            )
            for file, of in scored
        )  # fmt: skip
        if lines:
            groups.append(("", lines))
    titles = ("dataset", "method", "EPE", "wrong", "valid", "pairs")
    columns = tuple(Column(title, k > 1) for k, title in enumerate(titles))
    return Table(columns, tuple(groups)) if groups else None


def _audits(root: Path, out: Path) -> Table | None:
    lines = []
    for page in sorted(root.glob(PAGES[2])):
        of = _read(page.with_name("summary.json"))
        verdicts = of.get("verdicts", {})
        lines.append(
            (
                link_cell(page.parent.name, way(out, page)),
                value_cell(of.get("pairs"), "d"),
                value_cell(verdicts.get("good"), "d"),
                value_cell(verdicts.get("fault"), "d", bad=bool(verdicts.get("fault"))),
                value_cell(verdicts.get("undecided"), "d"),
                link_cell("pairs.csv", way(out, page.with_name("pairs.csv"))),
            )
        )
    titles = ("dataset", "pairs", "good", "failed", "too few matches", "every figure")
    return Table.of(titles, lines, words=(0, 5))


def _surface_models(root: Path, out: Path) -> Table | None:
    """A row per scene and method whose surface model is judged."""
    lines = []
    for page in sorted(root.glob(PAGES[3])):
        of = _read(page.with_name("scores.json"))
        errors, edges = of["errors"]["off steps"], of["edges"]
        lines.append(
            (
                link_cell(page.parts[-3], way(out, page)),
                Cell(page.parts[-2], page.parts[-2]),
                value_cell(errors["mean_absolute_m"], ".2f", unit=" m"),
                value_cell(errors["known_share"], ".1f", 100, " %"),
                value_cell(edges["position_error_m"], ".2f", unit=" m"),
            )
        )
    titles = ("scene", "method", "mean absolute error off steps", "known", "edges of roofs off by")
    return Table.of(titles, lines, words=(0, 1))
