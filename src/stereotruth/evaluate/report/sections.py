"""What a city's page says in figures: those on top, of which it folds all but six, and tables.

What images and control points say of a scene is as ``export.json`` has it and as the last lines of
a run print it: over all matches and all labelled pixels of a scene. More of it is in the tables.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...pages.tables import (
    Headline,
    Table,
    cells_of,
    columns_of,
    joined,
    limit,
    metres,
    minus,
    missed,
    number,
    spread,
    table,
    texts,
    words,
)
from ...tiles.label_doubts import ABOUT, ALIGNMENT, LIDAR
from ...tiles.label_moves import Moves, worst_point
from ...tiles.manifest import NONE, SPLITS
from ...tiles.sift_matches import SIFT_NOISE_PX
from .city_pictures import calibration

VIEWS = ("left", "right")
Rows = Sequence[Mapping[str, str]]
Record = Mapping[str, Any]
Records = Mapping[str, Record]

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


def headlines(
    rows: Rows,
    alignments: Records,
    refined: Records,
    truth: Rows,
    export: Mapping[str, Any],
    height_m_per_px: float | None = None,
) -> list[Headline]:
    """The figures of a city; those whose input is missing are left out.

    ``rows`` of the manifest, ``truth`` of truth.csv, ``export``: export.json, and what is known
    ``since_last_run``; ``alignments``, ``refined`` by scene; ``height_m_per_px``: metres of height
    for one px of disparity.
    """
    quality = export.get("quality", {})
    labelled = [row for row in rows if row["complete"] == "yes"]
    scenes = list(quality.get("scenes", {}).values())
    by_scope = {row["scope"]: row for row in truth}
    best = by_scope.get("tiles") or by_scope.get("scene") or {}
    error = number(best.get("mean_absolute_px", ""))
    found = _uncertainty(export.get("label_uncertainty", {}), height_m_per_px, error)
    if error is not None:
        note = joined("mean absolute", metres(error, height_m_per_px))
        found.append(Headline("error against the truth", f"{error:.3f} px", note))
    found += _moved(export.get("since_last_run", {}))
    found.append(_pairs(rows, labelled))
    shares = [s for row in labelled if (s := number(row["labelled_share"])) is not None]
    if shares:
        note = f"per tile {spread([100 * s for s in shares], '.0f')} %"
        found.append(Headline("pixels labelled", f"{100 * np.mean(shares):.1f} %", note))
    if "quality" in rows[0]:
        found.append(_gates(labelled, quality))
    found += _sift(scenes, height_m_per_px)
    if any(of.get(view, {}).get("gcps") for of in alignments.values() for view in VIEWS):
        found.append(_gcps(alignments, refined))
    if dense := [d for of in scenes if (d := of.get("lidar_points_per_m2")) is not None]:
        text = f"{spread(dense, '.2g')} points/m²"
        found.append(Headline("LiDAR density", text, "over the ground that it covers"))
    found += _lidar([of for scene in scenes if (of := scene.get("lidar"))], labelled)
    low = [v for row in labelled if (v := number(row["disparity_min_px"])) is not None]
    high = [v for row in labelled if (v := number(row["disparity_max_px"])) is not None]
    if low and high:
        text = minus(f"{min(low):.0f} … {max(high):.0f} px")
        note = metres(max(high) - min(low), height_m_per_px) or "of the tiles"
        found.append(Headline("disparities", text, note))
    return found


def _moved(scenes: Mapping[str, Any]) -> list[Headline]:
    """How far labels have moved since the last run, by scene; nothing after a first one."""
    moved = {scene: Moves(**values) for scene, values in scenes.items()}
    if not moved:
        return []
    medians = [(of.median_px, of.height_median_m) for of in moved.values()]
    text = ", ".join(f"{spread(of, '.3f')} {unit}" for of, unit in zip(zip(*medians), ("px", "m")))
    notes = [f"{scene}: {of}" if len(moved) > 1 else str(of) for scene, of in moved.items()]
    return [Headline("moved since the last run", text, "; ".join(notes))]


def _uncertainty(
    by: Mapping[str, Any], height_m_per_px: float | None, error_px: float | None
) -> list[Headline]:
    """How well labels are known by what they state: of all, and by what they lie on; and by the
    exact truth, mean absolute ``error_px``, where there is one."""
    if "all" not in by:
        return []
    median, most = (by["all"][f"uncertainty_{name}_px"] for name in ("median", "p95"))
    surfaces = ", ".join(
        f"{name.replace('_', ' ')} {of['uncertainty_median_px']:.2g}"
        for name, of in by.items()
        if name != "all"
    )
    note = joined(
        f"median; {most:.2g} px for 95 %",
        "" if error_px is None else f"by the exact truth off by {error_px:.2g} px in the mean",
        metres(median, height_m_per_px),
        f"medians: {surfaces}",
    )
    return [Headline("labels known to", f"{median:.2g} px", note)]


def _lidar(scenes: Sequence[Mapping[str, Any]], labelled: Rows) -> list[Headline]:
    """What was read of the LiDAR, by the scene of which most was, and what is missing."""
    if not scenes:
        return []
    most = max(scenes, key=lambda of: of["bytes"][0])
    (read, every), files = most["bytes"], most["files"]
    nodes = f", {most['nodes'][0]} of {most['nodes'][1]} nodes" if most["nodes"] else ""
    holes = [of for of in scenes if of["holes_m2"] or of["not_read_m2"]]
    note = f"points in {files[0]} of {files[1]} files{nodes}"
    for of in holes[:1]:
        if of["holes_m2"]:
            lon, lat = of["hole"]
            note += f"; no point on {of['holes_m2'] / 1e6:.3f} km² that both images show, "
            note += f"around {lon:.5f}, {lat:.5f}"
        if of["not_read_m2"]:
            note += f"; {of['not_read_m2'] / 1e6:.3f} km² around the images were not read"
    text = f"{read / 1e6:.1f} of {every / 1e6:.1f} MB"
    read_of = Headline("LiDAR read", text, note, bool(holes))
    return [read_of, *_dates(scenes, labelled), *_strips(scenes)]


def _strips(scenes: Sequence[Mapping[str, Any]]) -> list[Headline]:
    """How far strips are off those with most ground, of the scene where they are most in height."""
    found = []
    for strips in filter(None, (of.get("strips") for of in scenes)):
        off = [row for row in strips["strips"] if row["beyond_noise"]]
        if off:
            up_m = max(abs(row["up_m"]) for row in off)
            plan_m = max(math.hypot(row["east_m"], row["north_m"]) for row in off)
            found.append((up_m, plan_m, len(off), len(strips["strips"]), strips["taken_out"]))
    if not found:
        return []
    up_m, plan_m, off_count, count, taken_out = max(found)
    note = f"{off_count} of {count} strips are off by up to so much in height, {plan_m:.2f} m in "
    note += "plan; " + ("points are moved by that" if taken_out else "uncertainties have that")
    return [Headline("strips of the LiDAR", f"{100 * up_m:.0f} cm", note, not taken_out)]


def _dates(scenes: Sequence[Mapping[str, Any]], labelled: Rows) -> list[Headline]:
    """When the LiDAR was measured, the days from there to the images of tiles, and what its heights
    count from if that differs."""
    days = [of["acquired"] for of in scenes if of["acquired"]]
    surfaces = sorted({text for of in scenes for text in of["surfaces"]})
    mixed = any(len(of["surfaces"]) > 1 for of in scenes)
    if not days and not mixed:
        return []
    text = f"{min(d[0] for d in days)} to {max(d[1] for d in days)}" if days else "not known"
    some = f"of {len(days)} of {len(scenes)} scenes" if 0 < len(days) < len(scenes) else ""
    note = f"heights of different surfaces: {'; '.join(surfaces)}" if mixed else ""
    note = joined(some, _days_to_images(labelled), note)
    return [Headline("LiDAR measured", text, note, mixed)]


def _days_to_images(labelled: Rows) -> str:
    cells = [row.get(f"lidar_days_{view}", "") for row in labelled for view in ("left", "right")]
    days = [int(cell) for cell in cells if cell]
    if not days:
        return ""
    low, high = min(days), max(days)
    if low < 0 < high:
        return f"images from {-low} days earlier to {high} days later"
    text = spread([abs(day) for day in days], ".0f")
    return f"images {text} days {'later' if high > 0 else 'earlier'}"


def _pairs(rows: Rows, labelled: Rows) -> Headline:
    counts = [(s, sum(row["split"] == s for row in labelled)) for s in (*SPLITS, NONE)]
    note = ", ".join(f"{n} {s if s != NONE else 'of no split'}" for s, n in counts if n)
    if more := len(rows) - len(labelled):
        note = joined(note, f"{more} more without full labels")
    return Headline("labelled pairs", str(len(labelled)), note)


def _gates(labelled: Rows, quality: Mapping[str, Any]) -> Headline:
    bad = sum(bool(missed(row)) for row in labelled)
    scenes = [scene for scene, of in quality.get("scenes", {}).items() if missed(of)]
    note = f"and {', '.join(scenes)} as a whole" if scenes else ""
    doubts = quality.get("doubts", {})
    doubted = [s for s, of in doubts.items() if any(d.get("of") not in ABOUT for d in of)]
    told = [  # where alignment or LiDAR doubt labels by more than these state
        scene
        for scene, of in doubts.items()
        if any(d.get("of") in (ALIGNMENT, LIDAR) and not d["explained_by_alignment"] for d in of)
    ]
    if doubted:
        note = joined(note, f"images and labels disagree in {', '.join(doubted)}")
    if told:
        note = joined(note, f"alignment or LiDAR of {', '.join(told)} in doubt")
    met = "met, with doubts" if doubted or told else "all met"
    text = f"{bad} of {len(labelled)} tiles miss one" if bad or scenes else met
    return Headline("limits of quality", text, note, bool(bad or scenes or doubted or told))


def _sift(scenes: Sequence[Mapping[str, Any]], height_m_per_px: float | None) -> list[Headline]:
    """What SIFT matches say of the labels, scene by scene, and SIFT's own noise."""
    of = [scene for scene in scenes if scene.get("sift_mean_absolute_error_px") is not None]
    if not of:
        return []
    errors = [float(scene["sift_mean_absolute_error_px"]) for scene in of]
    height = metres(max(errors), height_m_per_px)
    note = joined(
        f"{len(of)} scenes" if of[1:] else "",
        f"{sum(scene['sift_matches'] for scene in of)} matches, mean absolute",
        f"about {SIFT_NOISE_PX:g} px of it SIFT's own",
        height and f"≤ {height}" if of[1:] else height,
    )
    return [Headline("SIFT disparity − label", f"{spread(errors, '.2f')} px", note)]


def _gcps(alignments: Records, refined: Records) -> Headline:
    def rms(records: Records, which: str) -> str:
        values = [
            record.get(view, {}).get("rms", {}).get(which)
            for record in records.values()
            for view in VIEWS
        ]
        return spread(values, ".2f")

    note = f"{rms(alignments, 'before')} px before"
    if refined:
        note += f", {rms(refined, 'after')} px after refinement"
    (_, worst), scene = max((worst_point(of), name) for name, of in (alignments | refined).items())
    note = joined(note, worst and (f"{scene}: {worst}" if len(alignments) > 1 else worst))
    return Headline("GCP residuals, rms", f"{rms(alignments, 'after')} px", note)


# ------------------------------------------------------------------------- tables of sections


def residuals(record: Record, later: Record) -> dict[str, Any]:
    """Of a scene: model, warnings, a table of the points, and what a refinement did."""
    points = []
    for view in VIEWS:
        for point in record.get(view, {}).get("gcps", []):
            row = {"image": view, "GCP": point["id"]}
            for which in ("before", "after", "leave_one_out"):
                pair = point.get(which, [None])
                row[f"{which}_px"] = "" if None in pair else f"{np.hypot(*pair):.3f}"
            used = "yes" if point.get("used", True) else "no"
            points.append(row | {"used": used, "reason": point.get("reason", "")})
    found = later.get("refinement", {})
    ties = [
        {
            "tie points": f"{words(name)} {when}",
            **{f"{k}_px": f"{v:.4f}" for k, v in values.items() if isinstance(v, int | float)},
        }
        for name in ("disparity", "y_parallax")
        for when in ("before", "after")
        if (values := found.get(when, {}).get(name))
    ]
    return {
        "model": record.get("model", ""),
        "warnings": list(dict.fromkeys([*record.get("warnings", []), *later.get("warnings", [])])),
        "points": table(points),
        "refinement": found,
        "ties": table(ties),
    }


def table4_beside_the_paper(rows: Rows) -> Table | None:
    """This run's rows of the paper's Table 4 above the published ones, in its columns first."""
    if not rows:
        return None
    names = list(rows[0])
    ours = tuple(cells_of(names, row) for row in rows)
    published = tuple(
        cells_of(names, dict(zip(names, [f"{name} ({kind})", *map(str, numbers)])))
        for name, kind, *numbers in PUBLISHED
    )
    groups = (("this run", ours), ("published: Li et al. 2023, table 4", published))
    return Table(columns_of(names, rows), groups)


def exact_truth(rows: Rows, record: Record) -> dict[str, Any] | None:
    """Figures of scenes and surfaces, of each tile, by status, and of the uncertainty."""
    if not rows:
        return None
    of_tiles = record.get("exported_tiles", {})
    groups = of_tiles.get("status", {})
    names = list(dict.fromkeys(name for counts in groups.values() for name in counts))
    by_status = [
        {"pixels that are": words(group), "count": str(total)}
        | {f"share_{name}": f"{counts.get(name, 0) / total:.6f}" for name in names}
        for group, counts in groups.items()
        if (total := sum(counts.values()))
    ]
    stated = of_tiles.get("calibration", {})
    caption = "Errors below once and twice their uncertainty; dashed: where it is right."
    if stated.get("share_below_1") is not None:
        caption += (
            f" {100 * stated['share_below_1']:.1f} % of all are below their uncertainty (68.3 % is "
            f"right), {100 * stated['share_below_2']:.1f} % below twice theirs (95.4 %)."
        )
    meaning = record.get("meaning", {})
    return {
        "whole": table([r for r in rows if not r["scope"].startswith("tile ")]),
        "tiles": table([r for r in rows if r["scope"].startswith("tile ")]),
        "status": table(by_status),
        "calibration": calibration(stated.get("deciles", []), caption),
        "meaning": {words(k): v for k, v in meaning.items() if isinstance(v, str)},
    }


def quality_gates(record: Record) -> dict[str, Any] | None:
    """The limits of the gates, the figures of each scene with the gates that it misses, doubts.

    And what the images say of the labels of each scene, by surface.
    """
    scenes = record.get("scenes", {})
    if not scenes:
        return None
    rows = [{"scene": scene, **texts(figures)} for scene, figures in scenes.items()]
    shown = [
        name
        for name in dict.fromkeys(["scene", "quality", *rows[0]])
        if name != "lidar" and any(row.get(name) for row in rows)  # what was read has its own card
    ]
    return {
        "table": table(rows, shown),
        "limits": [limit(name, v) for name, v in record.get("limits", {}).items() if v is not None],
        "doubts": [
            f"{scene}: {doubt['text']}"
            for scene, found in record.get("doubts", {}).items()
            for doubt in found
        ],
        "strips": table(
            [
                {"scene": scene, **texts(row)}
                for scene, figures in scenes.items()
                for row in ((figures.get("lidar") or {}).get("strips") or {}).get("strips", ())
            ]
        ),
        "surfaces": table(
            [
                {"scene": scene, "of": words(of), **texts(figures)}
                for scene, by in record.get("surfaces", {}).items()
                for of, figures in by.items()
            ]
        ),
    }
