"""The page of an audit: pooled figures, the worst pairs in pictures, a table of all pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from numpy.typing import NDArray

from ...dataset.stereo_dataset import StereoDataset
from ...products import pictures
from ...products.html_tables import minus, table
from ...products.pictures import encode, gradient
from ...products.rasters import read_image
from .matches import grey, label_offsets, match_pair
from .pair import EXTRA_PX
from .settings import Limits
from .summary import Audited, table_rows
from .verdicts import CHECKS, FAULT, GOOD, NOTE, UNDECIDED

Picture = pictures.Picture

SIDE, BYTES = 460, 60_000  # of a picture
DOT_PX = 3  # radius in the shown picture
LIMIT_PX = 3.0  # ends of the colours of label less match
ROW_LIMIT_PX = 1.5  # and of the vertical parallax
ERRORS = "RdYlBu_r"
COLUMNS = (
    "pair",
    "city",
    "split",
    "verdict",
    "matches",
    "parallax_px",
    "label_bias_px",
    "label_spread_px",
    "contradicted_share",
    "hidden_share",
    "labelled_share",
    "label_min_px",
    "label_max_px",
    "faults",
)


def write_page(
    path: Path,
    dataset: StereoDataset,
    audited: Sequence[Audited],
    summary: Mapping[str, Any],
    limits: Limits,
    worst: int,
) -> None:
    """Write the page; ``worst``: pairs that are shown in pictures."""
    order = sorted(audited, key=lambda a: (-a.severity(limits), a.pair.name))
    chosen = order[:worst]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("stereotruth.evaluation.audit", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    rows = table_rows(audited)
    html = environment.get_template("page.html.jinja").render(
        name=dataset.name,
        summary=summary,
        headlines=_headlines(summary),
        checks=[(CHECKS[name], counts) for name, counts in summary["checks"].items()],
        pooled=table(_pooled_rows(summary)),
        tiles=[_tile(dataset, a) for a in chosen],
        pairs=table(rows, COLUMNS),
        words=(FAULT, UNDECIDED, GOOD),
        errors=gradient(ERRORS),
        turbo=gradient("turbo"),
        limit=LIMIT_PX,
        row_limit=ROW_LIMIT_PX,
    )
    path.write_text(html, encoding="utf-8")


def _headlines(summary: Mapping[str, Any]) -> list[tuple[str, str, str, bool]]:
    """Title, value, note, whether it is bad."""
    verdicts, pooled = summary["verdicts"], summary["pooled"]
    faulty = verdicts[FAULT]
    found = [
        (
            "pairs without fault",
            f"{verdicts[GOOD]} of {summary['pairs']}",
            f"{faulty} faulty, {verdicts[UNDECIDED]} undecided",
            faulty > 0,
        )
    ]
    limits = summary["limits"]
    for name, title, tolerance, share in (
        ("parallax_px", "vertical parallax", limits["parallax_px"], False),
        ("label_bias_px", "labels less matches", limits["label_bias_px"], False),
        ("contradicted_share", "labels contradicted", limits["contradicted_share"], True),
        ("hidden_share", "labels on hidden pixels", limits["hidden_share"], True),
    ):
        if name in pooled:
            of = pooled[name]
            form = (lambda v: f"{100 * v:.1f} %") if share else (lambda v: f"{v:+.2f} px")
            ends = [form(of["least"]), form(of["most"])]
            value = ends[0] if ends[0] == ends[1] else " … ".join(ends)
            note = f"mean {form(of['mean'])}; tolerance {form(tolerance).lstrip('+')}"
            bad = max(abs(of["least"]), abs(of["most"])) > tolerance
            found.append((title, minus(value), minus(note), bad))
    return found


def _pooled_rows(summary: Mapping[str, Any]) -> list[dict[str, str]]:
    rows = []
    for name, of in summary["pooled"].items():
        text = {k: "" if of[k] is None else f"{of[k]:.4f}" for k in of if k != "pairs"}
        rows.append({"figure": name, "pairs": str(of["pairs"]), **text})
    return rows


def _dots(picture: Picture, x: NDArray, y: NDArray, values: NDArray, limit: float) -> Picture:
    """A grey picture of the width SIDE with a coloured dot for each value."""
    scale = SIDE / max(picture.shape)
    shown = pictures.shrink(picture, SIDE)
    canvas = np.ascontiguousarray(np.repeat((shown * 0.6).astype(np.uint8)[..., None], 3, axis=2))
    colours = pictures.colours(values[None, :], (-limit, limit), ERRORS)[0]
    order = np.argsort(np.abs(values))  # the worst on top
    for k in order:
        centre = (round(float((x[k] + 0.5) * scale)), round(float((y[k] + 0.5) * scale)))
        colour = tuple(int(c) for c in colours[k])
        cv2.circle(canvas, centre, DOT_PX, colour, -1, cv2.LINE_AA)
    return canvas


def _tile(dataset: StereoDataset, a: Audited) -> dict[str, Any]:
    """What the page shows of a pair."""
    left, right = read_image(a.pair.left), read_image(a.pair.right)
    grey_left = pictures.stretch(grey(left))
    found: dict[str, Any] = {
        "name": a.pair.name,
        "city": a.pair.city,
        "split": a.pair.split,
        "word": a.verdict.word,
        "findings": [
            (f.level, minus(f.text))
            for level in (FAULT, UNDECIDED, NOTE)
            for f in a.verdict.of(level)
        ],
        "pictures": [],
    }

    def add(title: str, picture: Picture, scale: tuple[str, str, str] | None = None) -> None:
        uri = encode(pictures.shrink(picture, SIDE), BYTES)
        found["pictures"].append({"title": title, "uri": uri, "scale": scale})

    add("left", grey_left)
    add("right", pictures.stretch(grey(right)))
    labels = None if a.pair.disparity is None else dataset.labels(a.pair)
    if labels is not None and np.isfinite(labels).any():
        low, high = (float(v) for v in np.nanpercentile(labels, (1, 99)))
        coloured = pictures.colours(labels, (low, high))
        add("labels", coloured, (minus(f"{low:.0f} px"), "turbo", minus(f"{high:.0f} px")))
    if "rows" not in a.figures:
        return found
    reach = max(abs(v) for v in dataset.disparity_range) + EXTRA_PX
    matches = match_pair(left, right, reach, nodata=left.dtype != np.uint8)
    x, y = matches.x, matches.y
    ends = minus(f"-{ROW_LIMIT_PX:g} px"), "errors", f"+{ROW_LIMIT_PX:g} px"
    add("vertical parallax", _dots(grey_left, x, y, matches.parallax, ROW_LIMIT_PX), ends)
    if labels is not None:
        error = label_offsets(grey(left), grey(right), labels, matches)
        known = np.isfinite(error)
        ends = minus(f"-{LIMIT_PX:g} px"), "errors", f"+{LIMIT_PX:g} px"
        dots = _dots(grey_left, x[known], y[known], error[known], LIMIT_PX)
        add("labels less matches", dots, ends)
    return found
