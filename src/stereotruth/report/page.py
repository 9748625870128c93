"""The page of a city: what was made, how good it is, and a look at every tile, in one file.

The page needs no network and no other file. Pictures lie in it as WebP, within ``PICTURE_BYTES``
in all: with many tiles, thumbnails get smaller and only some tiles have large pictures. A section
whose input is missing is left out. Equal input gives equal bytes.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from .. import figures
from ..errors import InputError
from ..grid_store import replacing
from ..runlog import progress
from ..splits import SPLITS
from . import drawings, pictures

PICTURE_BYTES = 24_000_000  # of all pictures as they stand in the page (base64)
BASE64 = 3 / 4  # bytes of a picture per byte in the page
SHARES = {"figures": 0.1, "thumbnails": 0.4, "sliders": 0.5}
COVERAGE_PX, FIGURE_PX, THUMBNAIL_PX, SLIDER_PX = 2200, 1400, 320, 900
THUMBNAIL_BYTES, SLIDER_BYTES = 24_000, 200_000  # at most, however few tiles there are
KINDS = ("left", "right", "disparity", "status")
LARGE = ("slider_left", "slider_warped", "slider_difference", "slider_disparity")
FILES = ("left", "right", "disp", "status", "orientation")  # columns of the manifest

# Table 4 of the paper: (city, class), pairs, matches, mean of mean errors and of mean absolute
# errors in px.
PUBLISHED = (
    ("Kunming", "building", 36, 3576, -0.69, 0.48),
    ("Kunming", "vegetation", 216, 54838, -0.869, 0.66),
    ("Qichun", "building", 128, 16643, -0.11, 0.51),
    ("Qichun", "vegetation", 736, 99457, -0.5, 0.79),
    ("Yingde", "building", 90, 13969, 0.09, 0.58),
    ("Yingde", "vegetation", 438, 63226, 0.11, 0.73),
    ("Shaoguan", "building", 77, 6744, -0.24, 0.42),
    ("Wuhan", "building", 20, 1776, -0.37, 0.49),
    ("Hengyang", "building", 22, 1139, -0.03, 0.32),
    ("US3D", "building", 49, 3750, -0.20, 0.89),
)


# -------------------------------------------------------------------------------------- values


@dataclass(frozen=True)
class Cell:
    """A value of a table: what is shown, what it is sorted by, and whether it misses a limit."""

    text: str
    key: str
    bad: bool = False


@dataclass(frozen=True)
class Column:
    """A column's heading, and whether its values are numbers."""

    title: str
    numeric: bool


@dataclass(frozen=True)
class Table:
    """A table of the page; ``groups`` are rows that belong together, under a heading or none."""

    columns: tuple[Column, ...]
    groups: tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]


@dataclass(frozen=True)
class Headline:
    """One of the figures on top: what, how much, a remark, and whether it misses a limit."""

    title: str
    value: str
    note: str = ""
    bad: bool = False


def words(name: str) -> str:
    """A column's name in words: underscores go, a unit at the end stands apart."""
    text = name.removeprefix("count_").replace("y_parallax", "y-parallax")
    if "share" in text:  # shown in percent
        return text.removeprefix("share_").removeprefix("of_").replace("_", " ")
    for ending, unit in (("_px", "px"), ("_dn", "DN")):
        if text.endswith(ending):
            return f"{text.removesuffix(ending).replace('_', ' ')}, {unit}"
    return text.replace("_", " ")


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if np.isfinite(value) else None


def minus(text: str) -> str:
    """A number's text with the true minus sign."""
    return text.replace("-", "−")


def show(name: str, text: str) -> str:
    """A value of the column ``name`` as people read it: shares in percent, else 3 decimals."""
    value = _number(text)
    if value is None:
        return text
    if "share" in name:
        return minus(f"{100 * value:.2f} %")
    if value == int(value) and "." not in text:
        whole = f"{int(value)}"
        return minus(f"{int(value):,}".replace(",", " ") if len(whole) > 5 else whole)
    if name in ("lon", "lat"):
        return minus(f"{value:.5f}")
    return minus(f"{value:.3f}")


def cell(name: str, text: str, bad: bool = False) -> Cell:
    """A table's cell of a value as it stands in a CSV file."""
    value = _number(text)
    return Cell(show(name, text), text if value is None else f"{value:.9g}", bad)


def table(rows: Sequence[Mapping[str, str]], columns: Sequence[str] | None = None) -> Table | None:
    """A table of CSV rows, with the given columns or all; None of no rows."""
    if not rows:
        return None
    names = list(rows[0]) if columns is None else [c for c in columns if c in rows[0]]
    return Table(_columns(names, rows), (("", tuple(_row(names, row) for row in rows)),))


def _columns(names: Iterable[str], rows: Sequence[Mapping[str, str]]) -> tuple[Column, ...]:
    def numeric(name: str) -> bool:
        values = [row[name] for row in rows if row.get(name)]
        return bool(values) and all(_number(value) is not None for value in values)

    return tuple(Column(words(name), numeric(name)) for name in names)


def _row(names: Iterable[str], row: Mapping[str, str]) -> tuple[Cell, ...]:
    return tuple(
        cell(name, row.get(name) or "", name == "quality" and bool(missed(row))) for name in names
    )


def missed(row: Mapping[str, Any]) -> list[str]:
    """Names of the quality gates that a tile of the manifest misses."""
    text = row.get("quality") or "ok"
    return [] if text == "ok" else [name.strip() for name in text.split(";") if name.strip()]


def spread(values: Iterable[float | None], form: str) -> str:
    """One value, or the least and the largest of several; a dash of none."""
    known = sorted(v for v in values if v is not None)
    if not known:
        return "–"
    low, high = (minus(format(v, form)) for v in (known[0], known[-1]))
    return low if low == high else f"{low}{' … ' if '−' in low + high else '–'}{high}"


# --------------------------------------------------------------------------------------- input


def _rows(path: str | Path | None) -> list[dict[str, str]]:
    """Rows of a CSV file; none if there is no such file."""
    if path is None or not Path(path).is_file():
        return []
    with Path(path).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _record(path: str | Path | None) -> dict[str, Any]:
    """A JSON file's object; empty if there is no such file."""
    if path is None or not Path(path).is_file():
        return {}
    return json.loads(Path(path).read_text(encoding="utf-8"))


# ------------------------------------------------------------------------------------ sections


def _residuals(
    alignments: Mapping[str, Mapping[str, Any]],
    refined: Mapping[str, Mapping[str, Any]],
    figures_of: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Per scene: frames of residual vectors, a table of the points, refinement, and warnings."""
    found = []
    for scene, record in alignments.items():
        frames = []
        stages = [("before", "RPC alone", record), ("after", "after the fit", record)]
        refinement = _refinement(refined.get(scene, {}))
        if scene in refined and (refinement is None or refinement["applied"]):
            stages.append(("after", "after refinement", refined[scene]))
        for view in ("left", "right"):
            fit = record.get(view, {})
            if not fit.get("gcps"):
                continue
            longest = {
                which: max(
                    drawings.longest_residual(source.get(view, {}).get("gcps", []), which)
                    for other, _, source in stages
                    if other == which
                )
                for which in ("before", "after")
            }
            for which, title, source in stages:
                of = source.get(view, {})
                rms = of.get("rms", {}).get(which)
                title = f"{view} image, {title}" + ("" if rms is None else f": {rms:.2f} px rms")
                points = of.get("gcps", [])
                frames.append(
                    drawings.arrow_frame(title, fit["size"], points, which, longest[which])
                )
        table_rows = [
            {
                "image": view,
                "GCP": point["id"],
                **{
                    f"{which}_px": f"{np.hypot(*point[which]):.3f}"
                    if None not in point.get(which, [None])
                    else ""
                    for which in ("before", "after", "leave_one_out")
                },
                "used": "yes" if point.get("used", True) else "no",
                "reason": point.get("reason", ""),
            }
            for view in ("left", "right")
            for point in record.get(view, {}).get("gcps", [])
        ]
        found.append(
            {
                "scene": scene,
                "model": record.get("model", ""),
                "frames": [frame for frame in frames if frame],
                "across": len(stages) if len(stages) > 2 else 4,
                "points": table(table_rows),
                "refinement": refinement,
                "figure": figures_of.get(scene),
                "warnings": [
                    *record.get("warnings", []),
                    *(
                        w
                        for w in refined.get(scene, {}).get("warnings", [])
                        if w not in record.get("warnings", [])
                    ),
                ],
            }
        )
    return found


def _histograms(
    rows: Sequence[Mapping[str, str]], made: Mapping[str, pictures.TilePictures]
) -> dict[str, list[drawings.Histogram]]:
    """Disparities of the tiles' files, by scene and by split."""

    def counted(key: str, value: str) -> dict[int, int]:
        total: dict[int, int] = {}
        for row in rows:
            if row.get(key) == value:
                for px, count in made[row["tile"]].histogram.items():
                    total[px] = total.get(px, 0) + count
        return total

    scenes = list(dict.fromkeys(row["scene"] for row in rows if row.get("disp")))
    splits = [s for s in (*SPLITS, "none") if any(row.get("split") == s for row in rows)]
    colour = "var(--accent)"
    return {
        "scene": drawings.histograms([(s, colour, counted("scene", s)) for s in scenes]),
        "split": drawings.histograms(
            [
                (s, figures.SPLIT_COLOURS[s], counted("split", s))
                for s in splits
                if any(row.get("split") == s and row.get("disp") for row in rows)
            ]
        ),
    }


def _shares(row: Mapping[str, str]) -> dict[str, float]:
    """Share of each status among the pixels of a tile, from its counts."""
    counts = {
        name.removeprefix("count_"): int(value)
        for name, value in row.items()
        if name.startswith("count_") and value
    }
    pixels = max(sum(counts.values()), 1)
    return {name: count / pixels for name, count in counts.items() if count}


def _index(rows: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Per scene: the box of all windows, and each window with its split, to be linked."""
    found = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        here = [row for row in rows if row["scene"] == scene]
        boxes = [(int(r["col0"]), int(r["row0"]), int(r["size"])) for r in here]
        left, top = min(b[0] for b in boxes), min(b[1] for b in boxes)
        right, bottom = max(b[0] + b[2] for b in boxes), max(b[1] + b[2] for b in boxes)
        windows = [
            {
                "tile": row["tile"],
                "number": row["number"],
                "x": x - left,
                "y": y - top,
                "size": size,
                "complete": row["complete"] == "yes",
                "colour": figures.SPLIT_COLOURS.get(row["split"], "#7f7f7f"),
                "bad": bool(missed(row)),
            }
            for row, (x, y, size) in zip(here, boxes)
        ]
        found.append(
            {"scene": scene, "width": right - left, "height": bottom - top, "windows": windows}
        )
    return found


def _table4(city: str, rows: Sequence[Mapping[str, str]]) -> Table | None:
    """This run's rows of the paper's Table 4 above the published ones."""
    if not rows:
        return None
    names = list(rows[0])
    found = [name for name in names if not name.startswith(("city", "class"))]
    ours = []
    for row in rows:
        kind = row.get("class", "")
        title = row.get("city", city) + (f" ({kind})" if kind else "")
        ours.append((Cell(title, title), *(cell(name, row[name]) for name in found)))
    published = []
    for name, kind, *numbers in PUBLISHED:
        title = f"{name} ({kind})"
        cells = [cell("", str(number)) for number in numbers]
        blank = [Cell("", "")] * (len(found) - len(cells))
        published.append((Cell(title, title), *cells[: len(found)], *blank))
    columns = (Column("city", False), *(Column(words(name), True) for name in found))
    return Table(
        columns,
        (
            ("this run", tuple(ours)),
            ("published: Li et al. 2023, table 4", tuple(published)),
        ),
    )


def _truth(rows: Sequence[Mapping[str, str]], record: Mapping[str, Any]) -> dict[str, Any] | None:
    """Figures of scenes and surfaces, of each tile, by status, and of the uncertainty."""
    if not rows:
        return None
    of_tiles = record.get("exported_tiles", {})
    groups = of_tiles.get("status", {})
    names = list(dict.fromkeys(name for counts in groups.values() for name in counts))
    by_status = []
    for group, counts in groups.items():
        total = sum(counts.values())
        if total:
            row = {"pixels that are": words(group), "count": str(total)}
            by_status.append(
                row | {f"share_{name}": f"{counts.get(name, 0) / total:.6f}" for name in names}
            )
    calibration = of_tiles.get("calibration", {})
    return {
        "whole": table([r for r in rows if not r["scope"].startswith("tile ")]),
        "tiles": table([r for r in rows if r["scope"].startswith("tile ")]),
        "status": table(by_status),
        "calibration": drawings.calibration(calibration.get("deciles", [])),
        "below": [calibration.get("share_below_1"), calibration.get("share_below_2")],
        "meaning": {
            words(k): v for k, v in record.get("meaning", {}).items() if isinstance(v, str)
        },
    }


def _quality(record: Mapping[str, Any]) -> dict[str, Any] | None:
    """The limits of the gates, and the figures of each scene with the gates that it misses."""
    scenes = record.get("scenes", {})
    if not scenes:
        return None
    rows = [
        {"scene": scene, **{k: "" if v is None else str(v) for k, v in figures.items()}}
        for scene, figures in scenes.items()
    ]
    limits = {words(k): v for k, v in record.get("limits", {}).items() if v is not None}
    return {"table": table(rows, ["scene", "quality", *rows[0]]), "limits": limits}


def _refinement(record: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a refinement found: whether it was applied, and tie points before and after."""
    found = record.get("refinement", {})
    if not found:
        return None
    rows = [
        {
            "tie points": f"{words(name)} {when}",
            **{f"{k}_px": f"{v:.4f}" for k, v in values.items() if isinstance(v, int | float)},
        }
        for name in ("disparity", "y_parallax")
        for when in ("before", "after")
        if (values := found.get(when, {}).get(name))
    ]
    return {
        "applied": bool(found.get("applied")),
        "reason": found.get("reason", ""),
        "table": table(rows),
        "used": found.get("used"),
        "sites": found.get("sites"),
        "meaning": found.get("meaning", ""),
    }


def _provenance(records: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Per product: software and code, parameters, inputs, as (name, value)."""

    def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
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


def _headlines(
    rows: Sequence[Mapping[str, str]],
    alignments: Mapping[str, Mapping[str, Any]],
    refined: Mapping[str, Mapping[str, Any]],
    truth: Sequence[Mapping[str, str]],
    quality: Mapping[str, Any],
) -> list[Headline]:
    """The figures on top of the page; those whose input is missing are left out."""
    labelled = [row for row in rows if row["complete"] == "yes"]
    counts = [(s, sum(row["split"] == s for row in labelled)) for s in (*SPLITS, "none")]
    found = [
        Headline(
            "labelled pairs",
            str(len(labelled)),
            ", ".join(f"{n} {s}" for s, n in counts if n),
        )
    ]
    if len(rows) > len(labelled):
        found.append(Headline("pairs without full labels", str(len(rows) - len(labelled))))
    shares = [_number(row["labelled_share"]) for row in labelled]
    known = [s for s in shares if s is not None]
    if known:
        percent = spread([100 * s for s in known], ".0f")
        found.append(
            Headline("pixels labelled", f"{100 * np.mean(known):.1f} %", f"per tile {percent} %")
        )
    low = [v for row in labelled if (v := _number(row["disparity_min_px"])) is not None]
    high = [v for row in labelled if (v := _number(row["disparity_max_px"])) is not None]
    if low and high:
        found.append(
            Headline("disparities", minus(f"{min(low):.0f} … {max(high):.0f} px"), "of the tiles")
        )
    if alignments:

        def rms(records: Mapping[str, Mapping[str, Any]], which: str) -> str:
            values = [
                record.get(view, {}).get("rms", {}).get(which)
                for record in records.values()
                for view in ("left", "right")
            ]
            return spread(values, ".2f")

        note = f"{rms(alignments, 'before')} px before"
        if refined:
            note += f", {rms(refined, 'after')} px after refinement"
        found.append(Headline("GCP residuals, rms", f"{rms(alignments, 'after')} px", note))

    ties = [record.get("refinement", {}) for record in refined.values()]
    if any(tie.get("after") for tie in ties):

        def parallax(when: str) -> str:
            values = [tie.get(when, {}).get("y_parallax", {}).get("rms") for tie in ties]
            return spread(values, ".2f")

        note = f"rms; {parallax('before')} px before refinement"
        found.append(Headline("y-parallax of tie points", f"{parallax('after')} px", note))

    def column(name: str) -> list[float]:
        return [v for row in labelled if (v := _number(row.get(name, ""))) is not None]

    if column("y_parallax_rms_px"):
        values = column("y_parallax_rms_px")
        found.append(
            Headline(
                "y-parallax of matches",
                f"{np.median(values):.2f} px",
                f"rms, median of tiles; {spread(values, '.2f')} px",
            )
        )
    if column("sift_mean_absolute_error_px"):
        values = column("sift_mean_absolute_error_px")
        count = int(sum(column("sift_matches")))
        found.append(
            Headline(
                "SIFT, mean absolute error",
                f"{np.mean(values):.2f} px",
                f"mean of {len(values)} tiles, {count} matches",
            )
        )
    if column("warp_correlation"):
        values = column("warp_correlation")
        found.append(
            Headline(
                "left and warped right",
                f"{np.median(values):.3f}",
                f"correlation, median of tiles; {spread(values, '.3f')}",
            )
        )
    by_scope = {row["scope"]: row for row in truth}
    best = by_scope.get("tiles") or by_scope.get("scene") or {}
    for title, name, form, factor, unit, note in (
        ("error against the truth", "mean_absolute_px", ".3f", 1, " px", "mean absolute"),
        ("off by more than 1 px", "share_over_1_px", ".3f", 100, " %", "of the labels, by truth"),
        ("visible pixels labelled", "share_of_visible_labelled", ".2f", 100, " %", "by truth"),
        ("hidden pixels labelled", "share_of_hidden_labelled", ".2f", 100, " %", "by truth"),
        ("y-parallax", "y_parallax_rms_px", ".3f", 1, " px", "rms, by truth"),
        (
            "errors below uncertainty",
            "share_below_1_uncertainty",
            ".1f",
            100,
            " %",
            "68.3 % is right",
        ),
    ):
        value = _number(best.get(name, ""))
        if value is not None:
            found.append(Headline(title, minus(format(factor * value, form)) + unit, note))
    if rows and "quality" in rows[0]:
        bad = sum(bool(missed(row)) for row in labelled)
        scenes = [scene for scene, of in quality.get("scenes", {}).items() if missed(of)]
        note = f"and {', '.join(scenes)} as a whole" if scenes else ""
        text = f"{bad} of {len(labelled)} tiles miss one" if bad or scenes else "all met"
        found.append(Headline("quality gates", text, note, bool(bad or scenes)))
    return found


def _chosen(names: Sequence[str], most: int) -> set[str]:
    """At most so many of the names, evenly chosen, the first and the last included."""
    if len(names) <= most:
        return set(names)
    picked = np.linspace(0, len(names) - 1, most).round().astype(int) if most else []
    return {names[k] for k in picked}


def _allowance(share: str, count: int, most: int) -> int:
    """Bytes of each of ``count`` pictures of a kind."""
    return min(most, int(PICTURE_BYTES * BASE64 * SHARES[share] / max(count, 1)))


def _manifest_columns(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Columns that differ between tiles, without files and checksums; quality first."""
    names = [
        name
        for name in rows[0]
        if name not in FILES
        and not name.endswith("_sha256")
        and (name in ("tile", "scene", "split", "quality") or len({r[name] for r in rows}) > 1)
        and name != "number"
    ]
    return sorted(names, key=lambda name: (name != "tile", name != "quality"))


def write_report(
    city: str,
    tiles: str | Path,
    out: str | Path,
    *,
    coverage: str | Path | None = None,
    alignments: Mapping[str, str | Path] | None = None,
    refinements: Mapping[str, str | Path] | None = None,
    refinement_figures: Mapping[str, str | Path] | None = None,
    truth: str | Path | None = None,
    truth_table: str | Path | None = None,
    table4: str | Path | None = None,
    sliders: int = 30,
    workers: int = 1,
    code: str = "",
) -> None:
    """Write the page of a city from its exported ``tiles``.

    ``coverage`` is the coverage map (PNG); ``alignments``, ``refinements``: alignment.json by
    scene, after the fit to the GCPs and after refinement; ``refinement_figures``: refinement.png
    by scene; ``truth``, ``truth_table``: truth.json and truth.csv; ``table4``: table4.csv.
    ``sliders``: most tiles with large pictures. Whatever is None or missing leaves its section out.

    Raises InputError if there is no manifest.
    """
    folder = Path(tiles)
    rows = _rows(folder / "manifest.csv")
    if not rows:
        raise InputError(
            "no manifest of tiles", file=folder / "manifest.csv", remedy="run the export stage"
        )
    records = {scene: _record(file) for scene, file in (alignments or {}).items()}
    records = {scene: record for scene, record in records.items() if record}
    refined = {scene: _record(file) for scene, file in (refinements or {}).items()}
    refined = {scene: record for scene, record in refined.items() if record}
    truth_rows, truth_record = _rows(truth_table), _record(truth)
    export = _record(folder / "export.json")

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

    def work(row: Mapping[str, str]) -> pictures.TilePictures:
        return pictures.tile_pictures(
            folder, row, thumbnail=thumbnail, slider=slider if row["tile"] in large else None
        )

    with ThreadPoolExecutor(workers) as pool:
        drawn = list(progress(pool.map(work, rows), len(rows), f"{city}: tiles drawn"))
    made = {row["tile"]: of for row, of in zip(rows, drawn)}
    statuses = [name.removeprefix("count_") for name in rows[0] if name.startswith("count_")]
    total = {name: 0.0 for name in statuses}
    for row in rows:
        if row["complete"] == "yes":
            for name, share in _shares(row).items():
                total[name] += share / len(labelled)

    coverage = Path(coverage) if coverage is not None else None
    limit = _allowance("figures", 1 + len(refinement_figures or {}), 1_000_000)
    values = {
        "city": city,
        "headlines": _headlines(rows, records, refined, truth_rows, export.get("quality", {})),
        "rows": rows,
        "made": made,
        "missed": {row["tile"]: missed(row) for row in rows if missed(row)},
        "shares": {row["tile"]: _shares(row) for row in rows},
        "total": total,
        "status_colours": pictures.status_colours(statuses),
        "split_colours": figures.SPLIT_COLOURS,
        "turbo": pictures.gradient("turbo"),
        "diverging": pictures.gradient("RdBu"),
        "no_match": f"rgb{pictures.NO_MATCH}",
        "no_difference": f"rgb{pictures.NO_DIFFERENCE}",
        "coverage": (
            pictures.encode_file(coverage, limit, COVERAGE_PX)
            if coverage is not None and coverage.is_file()
            else None
        ),
        "index": _index(rows),
        "residuals": _residuals(
            records,
            refined,
            {
                scene: pictures.encode_file(Path(file), limit, FIGURE_PX)
                for scene, file in (refinement_figures or {}).items()
                if Path(file).is_file()
            },
        ),
        "histograms": _histograms(rows, made),
        "histogram_size": (drawings.WIDTH, drawings.HEIGHT),
        "manifest": table(rows, _manifest_columns(rows)),
        "table4": _table4(city, _rows(table4)),
        "truth": _truth(truth_rows, truth_record),
        "quality": _quality(export.get("quality", {})),
        "provenance": _provenance(
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
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"words": words, "minus": minus}
    with replacing(out) as scratch, scratch.open("w", encoding="utf-8") as stream:
        environment.get_template("page.html.jinja").stream(values).dump(stream)
