"""The index of a folder's pages: cities, benchmarks, audits, surface models, with their figures.

It lists what is there, and no plan of a run knows that beforehand. Each job that makes a page
writes the index before it ends, and so do each run and whoever opens it: what is recorded as made
is in it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import in_number
from ..products.html_page import INDEX, way, write_page
from ..products.html_tables import Cell, Column, Table, minus, spread
from ..products.locks import exclusive
from ..products.pictures import encode_file
from ..status import carries_label
from .timeline import last_run, read_jobs, timeline

PAGES = (
    "results/report/*/index.html",
    "benchmark/*/index.html",
    "audit/*/index.html",
    "score_dsm/*/*/*/index.html",
    "results/site/*/index.html",
)
TEMPLATE = Path(__file__).with_name("index.html.jinja")
LOOK_PX, LOOK_BYTES = 420, 30_000
NOTHING = Cell("", "")


def pages_of(root: Path) -> list[Path]:
    """All pages below a folder but the index, sorted."""
    return sorted(page for pattern in PAGES for page in root.glob(pattern))


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
    values = {
        "cities": [_city(root, out, page) for page in sorted(root.glob(PAGES[0]))],
        "benchmarks": _benchmarks(root, out),
        "audits": _audits(root, out),
        "surface_models": _surface_models(root, out),
        "sites": [
            (page.parent.name, str(way(out, page)), "images and pairs")
            for page in sorted(root.glob(PAGES[4]))
        ],
        "timeline": timeline(last_run(read_jobs(root))),
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


def _link(out: Path, page: Path, text: str) -> Cell:
    return Cell(text, text, href=str(way(out, page)))


def _value(value: float | None, form: str, factor: float = 1, unit: str = "") -> Cell:
    if value is None:
        return NOTHING
    return Cell(minus(f"{factor * value:{form}}{unit}"), f"{value:.9g}")


def _city(root: Path, out: Path, page: Path) -> dict[str, Any]:
    """What the index shows of a city; figures are those of ``export.json``."""
    name = page.parent.name
    tiles = root / "tiles" / name
    export = _read(tiles / "export.json")
    scenes = list(export.get("quality", {}).get("scenes", {}).values())
    facts = []
    if export:
        counts = export.get("splits", {}).get("realised", {})
        split = ", ".join(f"{n} {of}" for of, n in counts.items() if n)
        size = f"{export['size_px']} × {export['size_px']} px"
        pairs = in_number(export["labelled_pairs"], "labelled pair")
        facts.append(f"{pairs} of {size} ({split})")
        shares = export["share_of_pixels"]
        labelled = sum(share for status, share in shares.items() if carries_label(status))
        facts.append(f"{100 * labelled:.1f} % of their pixels labelled")
    sift = [of["sift_mean_absolute_error_px"] for of in scenes]
    if any(value is not None for value in sift):
        facts.append(f"SIFT disparity minus label: {spread(sift, '.2f')} px mean absolute")
    truth = _read(root / "results" / "evaluate" / name / "truth.json")
    truth = truth["exported_tiles"]["errors"] if truth else {}
    if truth.get("count"):
        facts.append(f"error against the exact truth: {truth['mean_absolute']:.3f} px")
    flagged = len(export.get("quality", {}).get("flagged_tiles", {}))
    look = root / "results" / "export" / name / "coverage.png"
    links = [(file, str(way(out, tiles / file))) for file in _files(tiles)]
    return {
        "name": name,
        "href": way(out, page),
        "look": encode_file(look, LOOK_BYTES, LOOK_PX) if look.is_file() else None,
        "facts": facts,
        "flagged": flagged,
        "links": links,
    }


def _files(folder: Path) -> Iterator[str]:
    for name in ("manifest.csv", "footprints.geojson", "export.json"):
        if (folder / name).is_file():
            yield name


def _benchmarks(root: Path, out: Path) -> Table | None:
    """A row per method that is scored, under its dataset."""
    groups = []
    for folder in sorted(root.glob("benchmark/*/")):
        page = folder / "index.html"
        lines = []
        for file in sorted(folder.glob("*/scores.json")):
            of = _read(file)
            total, limit = of["all"], of["thresholds_px"][0]
            lines.append(
                (
                    _link(out, page, folder.name) if page.is_file() else Cell(folder.name, ""),
                    _link(out, file.parent / "cities.csv", of["label"]),
                    _value(total["filled_epe_px"], ".3f", unit=" px"),
                    _value(
                        total[f"filled_d1_{limit:g}_px_share"], ".2f", 100, f" % ({limit:g} px)"
                    ),
                    _value(total["valid_share"], ".1f", 100, " %"),
                    _value(of["tiles"], "d"),
                )
            )
        lines.sort(key=lambda line: float(line[2].key or "inf"))
        if lines:
            groups.append(("", tuple(lines)))
    titles = ("dataset", "method", "EPE", "D1", "valid", "pairs")
    columns = tuple(Column(title, k > 1) for k, title in enumerate(titles))
    return Table(columns, tuple(groups)) if groups else None


def _audits(root: Path, out: Path) -> Table | None:
    lines = []
    for page in sorted(root.glob(PAGES[2])):
        of = _read(page.with_name("summary.json"))
        verdicts = of.get("verdicts", {})
        lines.append(
            (
                _link(out, page, page.parent.name),
                _value(of.get("pairs"), "d"),
                _value(verdicts.get("good"), "d"),
                Cell(str(n := verdicts.get("fault", "")), str(n), bad=bool(n)),
                _value(verdicts.get("undecided"), "d"),
                _link(out, page.with_name("pairs.csv"), "pairs.csv"),
            )
        )
    titles = ("dataset", "pairs", "good", "faulty", "undecided", "every figure")
    columns = tuple(Column(title, 0 < k < 5) for k, title in enumerate(titles))
    return Table(columns, (("", tuple(lines)),)) if lines else None


def _surface_models(root: Path, out: Path) -> Table | None:
    """A row per scene and method whose surface model is judged."""
    lines = []
    for page in sorted(root.glob(PAGES[3])):
        of = _read(page.with_name("scores.json"))
        errors, edges = of["errors"]["off steps"], of["edges"]
        lines.append(
            (
                _link(out, page, page.parts[-3]),
                Cell(page.parts[-2], page.parts[-2]),
                _value(errors["mean_absolute_m"], ".2f", unit=" m"),
                _value(errors["known_share"], ".1f", 100, " %"),
                _value(edges["position_error_m"], ".2f", unit=" m"),
            )
        )
    titles = ("scene", "method", "mean absolute error off steps", "known", "edges of roofs off by")
    columns = tuple(Column(title, k > 1) for k, title in enumerate(titles))
    return Table(columns, (("", tuple(lines)),)) if lines else None
