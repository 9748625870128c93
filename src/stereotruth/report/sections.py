"""The sections of a city's page: what each shows, from the products that it is given."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..dataset import quick_looks
from ..dataset.manifest import Tile
from ..dataset.split_names import NONE, SPLITS
from ..pages.figures import Chart
from ..pages.tables import Table, cells_of, columns_of, limit, missed, table, words
from . import drawings

FILES = ("left", "right", "disp", "status", "orientation")  # columns of the manifest
FIRST = ("tile", "quality", "scene", "split", "class", "labelled_share")  # and these come first

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


def residuals(
    alignments: Mapping[str, Mapping[str, Any]],
    refined: Mapping[str, Mapping[str, Any]],
    figures_of: Mapping[str, str | None],
) -> list[dict[str, Any]]:
    """Per scene: frames of residual vectors, a table of the points, refinement, and warnings."""
    found = []
    for scene, record in alignments.items():
        later = refined.get(scene, {})
        stages = [("before", "RPC alone", record), ("after", "after the fit", record)]
        said = refinement(later)
        if later and (said is None or said["applied"]):
            stages.append(("after", "after refinement", later))
        frames = [frame for view in ("left", "right") for frame in _frames(view, stages)]
        warnings = [*record.get("warnings", []), *later.get("warnings", [])]
        found.append(
            {
                "scene": scene,
                "model": record.get("model", ""),
                "frames": frames,
                "across": len(stages) if len(stages) > 2 else 4,
                "points": table(_points(record)),
                "refinement": said,
                "figure": figures_of.get(scene),
                "warnings": list(dict.fromkeys(warnings)),
            }
        )
    return found


def _frames(
    view: str, stages: Sequence[tuple[str, str, Mapping[str, Any]]]
) -> list[drawings.ArrowFrame]:
    """One frame per stage (residual, words, alignment); equal residuals have one scale."""
    fits = [(which, text, record.get(view, {})) for which, text, record in stages]
    longest: dict[str, float] = {}
    for which, _, fit in fits:
        here = drawings.longest_residual(fit.get("gcps", []), which)
        longest[which] = max(longest.get(which, 0.0), here)
    frames = []
    for which, text, fit in fits:
        rms = fit.get("rms", {}).get(which)
        title = f"{view} image, {text}" + ("" if rms is None else f": {rms:.2f} px rms")
        frames.append(
            drawings.arrow_frame(
                title, fit.get("size", (1, 1)), fit.get("gcps", []), which, longest[which]
            )
        )
    return [frame for frame in frames if frame]


def _points(record: Mapping[str, Any]) -> list[dict[str, str]]:
    """Rows of the GCPs of both views, with the lengths of their residuals."""

    def length(pair: Sequence[float | None]) -> str:
        return "" if None in pair else f"{np.hypot(*pair):.3f}"

    return [
        {
            "image": view,
            "GCP": point["id"],
            **{
                f"{which}_px": length(point.get(which, [None]))
                for which in ("before", "after", "leave_one_out")
            },
            "used": "yes" if point.get("used", True) else "no",
            "reason": point.get("reason", ""),
        }
        for view in ("left", "right")
        for point in record.get(view, {}).get("gcps", [])
    ]


def histograms(
    rows: Sequence[Mapping[str, str]], counts: Mapping[str, Mapping[int, int]]
) -> dict[str, list[Chart]]:
    """Disparities of the tiles' files, by scene and by split; ``counts`` by tile."""

    def counted(key: str, value: str) -> dict[int, int]:
        total: dict[int, int] = {}
        for row in rows:
            if row.get(key) == value:
                for px, count in counts[row["tile"]].items():
                    total[px] = total.get(px, 0) + count
        return total

    scenes = list(dict.fromkeys(row["scene"] for row in rows if row.get("disp")))
    splits = [s for s in (*SPLITS, NONE) if any(row.get("split") == s for row in rows)]
    colour = "var(--accent)"
    return {
        "scene": drawings.histograms([(s, colour, counted("scene", s)) for s in scenes]),
        "split": drawings.histograms(
            [
                (s, quick_looks.SPLIT_COLOURS[s], counted("split", s))
                for s in splits
                if any(row.get("split") == s and row.get("disp") for row in rows)
            ]
        ),
    }


def status_shares(row: Mapping[str, str]) -> dict[str, float]:
    """Share of each status among the pixels of a tile, from its counts."""
    counts = {
        name.removeprefix("count_"): int(value)
        for name, value in row.items()
        if name.startswith("count_") and value
    }
    pixels = max(sum(counts.values()), 1)
    return {name: count / pixels for name, count in counts.items() if count}


def tile_index(rows: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Per scene: the box of all windows, and each window with its split, to be linked."""
    found = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        here = [row for row in rows if row["scene"] == scene]
        boxes = [(tile.col0, tile.row0, tile.size) for tile in map(Tile.of, here)]
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
                "colour": quick_looks.SPLIT_COLOURS.get(
                    row["split"], quick_looks.SPLIT_COLOURS[NONE]
                ),
                "bad": bool(missed(row)),
            }
            for row, (x, y, size) in zip(here, boxes)
        ]
        found.append(
            {"scene": scene, "width": right - left, "height": bottom - top, "windows": windows}
        )
    return found


def table4_beside_the_paper(rows: Sequence[Mapping[str, str]]) -> Table | None:
    """This run's rows of the paper's Table 4 above the published ones, in its columns first."""
    if not rows:
        return None
    names = list(rows[0])
    ours = tuple(cells_of(names, row) for row in rows)
    published = []
    for name, kind, *numbers in PUBLISHED:
        values = [f"{name} ({kind})", *map(str, numbers)]
        published.append(cells_of(names, dict(zip(names, values))))
    groups = (("this run", ours), ("published: Li et al. 2023, table 4", tuple(published)))
    return Table(columns_of(names, rows), groups)


def exact_truth(
    rows: Sequence[Mapping[str, str]], record: Mapping[str, Any]
) -> dict[str, Any] | None:
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
        "calibration": drawings.calibration(
            calibration.get("deciles", []), _below_uncertainty(calibration)
        ),
        "meaning": {
            words(k): v for k, v in record.get("meaning", {}).items() if isinstance(v, str)
        },
    }


def _below_uncertainty(calibration: Mapping[str, Any]) -> str:
    """What share of the errors is below their uncertainty, over all labels."""
    once, twice = (calibration.get(f"share_below_{k}") for k in (1, 2))
    text = "Errors below once and twice their uncertainty."
    if once is None or twice is None:
        return text
    return (
        f"{text} {100 * once:.1f} % of the errors are below their uncertainty (68.3 % is right), "
        f"{100 * twice:.1f} % below twice theirs (95.4 %)."
    )


def quality_gates(record: Mapping[str, Any]) -> dict[str, Any] | None:
    """The limits of the gates, the figures of each scene with the gates that it misses, doubts.

    And what the images say of the labels of each scene, by surface.
    """
    scenes = record.get("scenes", {})
    if not scenes:
        return None
    rows = [
        {"scene": scene, **{k: "" if v is None else str(v) for k, v in figures.items()}}
        for scene, figures in scenes.items()
    ]
    shown = [
        name
        for name in dict.fromkeys(["scene", "quality", *rows[0]])
        if name != "lidar" and any(row.get(name) for row in rows)  # what was read has its own card
    ]
    limits = [limit(name, v) for name, v in record.get("limits", {}).items() if v is not None]
    return {
        "table": table(rows, shown),
        "limits": limits,
        "doubts": [
            f"{scene}: {doubt['text']}"
            for scene, found in record.get("doubts", {}).items()
            for doubt in found
        ],
        "strips": table(
            [
                {"scene": scene, **{k: "" if v is None else str(v) for k, v in row.items()}}
                for scene, figures in scenes.items()
                for row in ((figures.get("lidar") or {}).get("strips") or {}).get("strips", ())
            ]
        ),
        "surfaces": table(
            [
                {"scene": scene, "of": words(of), **{k: str(v) for k, v in figures.items()}}
                for scene, by in record.get("surfaces", {}).items()
                for of, figures in by.items()
            ]
        ),
    }


def refinement(record: Mapping[str, Any]) -> dict[str, Any] | None:
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
        "remark": found.get("remark", ""),
        "table": table(rows),
        "used": found.get("used"),
        "sites": found.get("sites"),
        "meaning": found.get("meaning", ""),
    }


def provenance(records: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
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


def manifest_columns(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Columns that differ between tiles, without files and checksums; ``FIRST`` first."""
    names = [
        name
        for name in rows[0]
        if name not in FILES
        and not name.endswith("_sha256")
        and (name in ("tile", "scene", "split", "quality") or len({r[name] for r in rows}) > 1)
        and name != "number"
    ]
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
