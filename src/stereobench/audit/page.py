"""The page of an audit: all pairs in one picture, the worst in large, a table of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from stereotruth.core.config.methods import Audit, AuditLimits
from stereotruth.core.products.rasters import read_image
from stereotruth.pages import pictures
from stereotruth.pages.figures import AXES, Chart, Plot, look, styled
from stereotruth.pages.page import write_page
from stereotruth.pages.pictures import Scale, encode
from stereotruth.pages.tables import Cell, Headline, Table, minus, table, value_cell, words
from stereotruth.tiles.stereo_dataset import StereoDataset

from .matches import grey, label_offsets
from .pair import estimate, matches_of
from .verdicts import CHECKS, FAULT, GOOD, NOTE, UNDECIDED, Audited, as_text, table_rows

Picture = pictures.Picture

SIDE, BYTES = 460, 60_000  # of a picture
DOT_PX = 3  # radius in the shown picture
LIMIT_PX = 3.0  # ends of the colours of label − match
ROW_LIMIT_PX = 1.5  # and of the vertical parallax
WORDS = {GOOD: "good", FAULT: "failed", UNDECIDED: "too few matches"}
TEMPLATE = Path(__file__).with_name("page.html.jinja")
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


def write_audit(
    path: Path,
    dataset: StereoDataset,
    audited: Sequence[Audited],
    summary: Mapping[str, Any],
    settings: Audit,
    *,
    index: str | None = None,
) -> None:
    """Write the page; ``index``: the way to all pages.

    ``path`` lies beside the audit's other files.
    """
    order = sorted(audited, key=lambda a: (-a.severity(settings), a.pair.name))
    chosen = order[: settings.worst]
    shown = {a.pair.name for a in chosen}
    values = {
        "index": index,
        "name": dataset.name,
        "summary": summary,
        "links": [
            ("pairs.csv", "pairs.csv", "every figure of every pair"),
            ("summary.json", "summary.json", "the dataset as a whole"),
            ("README.txt", "README.txt", "the same in words"),
        ],
        "headlines": headlines(summary),
        "checks": _checks(summary),
        "chart": all_pairs(audited, settings, shown),
        "pooled": table(
            [
                {"figure": words(name), **{key: as_text(value) for key, value in of.items()}}
                for name, of in summary["pooled"].items()
            ]
        ),
        "shared": _shared(summary),
        "conventions": [
            (words(name), ", ".join(f"{value} ({n} pairs)" for value, n in counts.items()))
            for name, counts in summary["conventions"].items()
        ],
        "tiles": [_tile(dataset, a) for a in chosen],
        "pairs": _pairs(audited, shown),
    }
    write_page(path, TEMPLATE, values)


def headlines(summary: Mapping[str, Any]) -> list[Headline]:
    """The figures on top."""
    verdicts, pooled = summary["verdicts"], summary["pooled"]
    faulty = verdicts[FAULT]
    value = f"{verdicts[GOOD]} of {summary['pairs']}"
    note = f"{faulty} failed, {verdicts[UNDECIDED]} with too few matches"
    found = [Headline("pairs without fault", value, note, faulty > 0)]
    limits = summary["limits"]
    for name, title, tolerance, share in (
        ("parallax_px", "vertical parallax", limits["parallax_px"], False),
        ("label_bias_px", "label − match", limits["label_bias_px"], False),
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
            found.append(Headline(title, minus(value), minus(note), bad))
    return found


@styled
def all_pairs(audited: Sequence[Audited], limits: AuditLimits, linked: set[str]) -> Chart | None:
    """All pairs that have both: label bias over vertical parallax, px; the box is tolerated.

    ``linked``: names of pairs that the page shows in large.
    """
    where = ("rows", "parallax"), ("bias", "bias")
    at = {a.pair.name: [estimate(a.figures, *of).value for of in where] for a in audited}
    at = {name: values for name, values in at.items() if np.isfinite(values).all()}
    if not at:
        return None
    without = len(audited) - len(at)
    plot = Plot.of(
        "label − match over vertical parallax",
        "A mark is a pair; within the box both are tolerated (faults of other kinds may lie there, "
        "too). Linear near zero, logarithmic beyond."
        + (f" {without} pairs have not both figures." if without else ""),
        (6.4, 4.6),
    )
    tolerances = limits.parallax_px, limits.label_bias_px
    corner, size = [-t for t in tolerances], [2 * t for t in tolerances]
    plot.axis.add_patch(Rectangle(corner, *size, facecolor=AXES, alpha=0.25))
    values = []
    for number, (verdict, word) in enumerate(WORDS.items()):
        of = [a for a in audited if a.verdict == verdict and a.pair.name in at]
        if not of:
            continue
        names = [a.pair.name for a in of]
        x, y = zip(*(at[name] for name in names))
        style = look(number) | {"linestyle": "none"}
        (marks,) = plot.axis.plot(x, y, label=f"{word}: {len(of)}", **style)
        texts = [
            minus(f"{name}: parallax {a:+.2f} px, label - match {b:+.2f} px")
            for name, a, b in zip(names, x, y)
        ]
        plot.hover(marks, texts, [f"#pair-{name}" if name in linked else "" for name in names])
        values += [
            {"pair": name, "verdict": word, "parallax_px": a, "label_bias_px": b}
            for name, a, b in zip(names, x, y)
        ]
    for set_scale, tolerance in zip((plot.axis.set_xscale, plot.axis.set_yscale), tolerances):
        set_scale("symlog", linthresh=tolerance)
    for axis in (plot.axis.xaxis, plot.axis.yaxis):
        axis.set_major_formatter(lambda value, _: minus(f"{value:g}"))
    plot.axis.set(xlabel="vertical parallax, px", ylabel="label − match, px")
    plot.figure.legend(loc="outside lower center", ncols=3)
    return plot.chart(values)


def _checks(summary: Mapping[str, Any]) -> Table | None:
    lines = [
        (
            Cell(CHECKS[name], CHECKS[name]),
            value_cell(counts[FAULT], "d", bad=counts[FAULT] > 0),
            value_cell(counts[UNDECIDED], "d"),
        )
        for name, counts in summary["checks"].items()
    ]
    return Table.of(("what may be wrong", "pairs", "too few matches"), lines)


def _shared(summary: Mapping[str, Any]) -> Table | None:
    rows = [
        {
            "pair": of["first"],
            "split": of["first_split"],
            "other pair": of["second"],
            "its split": of["second_split"],
            "matches": str(of["matches"]),
            "share_of_the_ground": str(of["share"]),
        }
        for of in summary["shared"]
    ]
    return table(rows)


def _pairs(audited: Sequence[Audited], shown: set[str]) -> Table | None:
    """The table of all pairs; each fault has its line, and a click leads to the pictures."""
    rows = table_rows(audited)
    for row, a in zip(rows, audited):
        row["faults"] = minus("\n".join(f.text.replace("; ", "\n") for f in a.of(FAULT)))
        row["verdict"] = WORDS[a.verdict]
    return table(rows, COLUMNS, {"pair": {name: f"#pair-{name}" for name in shown}})


def _dots(picture: Picture, x: NDArray, y: NDArray, values: NDArray, limit: float) -> Picture:
    """A grey picture of the width SIDE with a coloured dot for each value."""
    scale = SIDE / max(picture.shape)
    shown = pictures.shrink(picture, SIDE)
    canvas = np.ascontiguousarray(np.repeat((shown * 0.6).astype(np.uint8)[..., None], 3, axis=2))
    colours = pictures.colours(values[None, :], (-limit, limit), pictures.DIFFERENCES)[0]
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
        "verdict": a.verdict,
        "word": WORDS[a.verdict],
        "findings": [
            (f.level, minus(text))
            for level in (FAULT, UNDECIDED, NOTE)
            for f in a.of(level)
            for text in f.text.split("; ")
        ],
        "pictures": [],
    }

    def add(title: str, picture: Picture, scale: Scale | None = None) -> None:
        uri = encode(pictures.shrink(picture, SIDE), BYTES)
        found["pictures"].append({"title": title, "uri": uri, "scale": scale})

    def differences(limit: float) -> Scale:
        return Scale.of(pictures.DIFFERENCES, f"−{limit:g} px", f"+{limit:g} px")

    add("left", grey_left)
    add("right", pictures.stretch(grey(right)))
    labels = None if a.pair.disparity is None else dataset.labels(a.pair)
    if labels is not None and np.isfinite(labels).any():
        low, high = (float(v) for v in np.nanpercentile(labels, (1, 99)))
        ends = (minus(f"{value:.0f} px") for value in (low, high))
        coloured = pictures.colours(labels, (low, high))
        add("labels", coloured, Scale.of(pictures.DISPARITIES, *ends))
    if "rows" not in a.figures:
        return found
    matches = matches_of(dataset, left, right)
    x, y = matches.x, matches.y
    dots = _dots(grey_left, x, y, matches.parallax, ROW_LIMIT_PX)
    add("vertical parallax", dots, differences(ROW_LIMIT_PX))
    if labels is not None:
        error = label_offsets(grey(left), grey(right), labels, matches)
        known = np.isfinite(error)
        dots = _dots(grey_left, x[known], y[known], error[known], LIMIT_PX)
        add("label − match", dots, differences(LIMIT_PX))
    return found
