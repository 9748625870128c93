"""The page of a site: where its images lie, its pairs by quality, residuals by image, closure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from ..epipolar import site_pairs
from ..epipolar.linked_images import Links
from ..epipolar.pair_quality import rate
from ..numerics.degrees import metres_per_degree
from ..pages.figures import Axis
from ..pages.page import way, write_page
from ..pages.tables import Table, table
from ..pages.pictures import DISPARITIES, SERIES, gradient, round_length

TEMPLATE = Path(__file__).with_name("site_page.html.jinja")
SIDE, WIDTH, HEIGHT = 600.0, 620.0, 360.0
FIRST_DAY = 1.0  # below it, the axis of days is linear


@dataclass(frozen=True)
class SiteImage:
    """An image: when it was taken (text), its corners on the ground as (lon, lat) degrees."""

    name: str
    acquired: str
    corners: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Pair:
    """A pair of images; ``matched``: predicted share; ``scene`` that is made of it, or empty."""

    left: str
    right: str
    matched: float
    convergence: float
    days: float | None
    reason: str
    scene: str


def image_of(image: site_pairs.SiteImage) -> SiteImage:
    """An image with its corners at the height of its RPC."""
    cols, rows = image.size
    lon, lat = image.sensor.localize(
        np.array([0.0, cols - 1.0, cols - 1.0, 0.0]),
        np.array([0.0, 0.0, rows - 1.0, rows - 1.0]),
        float(image.sensor.rpc.height_off),
    )
    corners = [(float(x), float(y)) for x, y in zip(lon, lat)]
    return SiteImage(image.name, "" if image.time is None else f"{image.time:%Y-%m-%d}", corners)


def pairs_of(
    images: Sequence[site_pairs.SiteImage],
    scenes: Mapping[str, tuple[str, str]],
    roughness_m: float | None,
) -> list[Pair]:
    """All pairs of a site, best first.

    ``scenes``: names of the images of each, in any order; ``roughness_m`` of the site, None: not
    known.
    """
    names = {frozenset(pair): scene for scene, pair in scenes.items()}
    return [
        Pair(
            one.pair.left,
            one.pair.right,
            one.quality.matched,
            one.pair.convergence,
            one.pair.days,
            one.quality.reason,
            names.get(frozenset((one.pair.left, one.pair.right)), ""),
        )
        for one in rate(images, roughness_m)
    ]


def write_site_page(
    city: str,
    images: Sequence[SiteImage],
    pairs: Sequence[Pair],
    out: str | Path,
    *,
    adjusted: Mapping[str, Any],
    closure: Mapping[str, Any],
    page: str | Path | None,
    index: str | Path | None,
) -> None:
    """Write the page of a site to ``out``.

    ``adjusted``, ``closure``: records of ``results/adjust`` and ``results/closure``, empty if there
    are none; ``page``: of the city's scenes and tiles, None if there is none; ``index``: of all
    pages.
    """
    values = {
        "city": city,
        "index": way(out, index),
        "page": way(out, page),
        "map": _map(images),
        "pairs": _chart(pairs),
        "table": _pairs_table(pairs, way(out, page)),
        "residuals": _residuals(adjusted),
        "remarks": _remarks(adjusted),
        "closure": _closure(closure),
        "qualities": gradient(DISPARITIES),
        "scenes": [pair.scene for pair in pairs if pair.scene],
        "images": images,
        "unlinked": _unlinked(images, pairs),
    }
    write_page(out, TEMPLATE, values)


def _unlinked(images: Sequence[SiteImage], pairs: Sequence[Pair]) -> list[str]:
    """Images that no scene uses, and groups that none links."""
    made = [(pair.left, pair.right) for pair in pairs if pair.scene]
    return Links.of((image.name for image in images), made).sentences


def _map(images: Sequence[SiteImage]) -> dict[str, Any]:
    """Footprints north up in an SVG view box (y down), and a bar for the scale."""
    every = np.array([corner for image in images for corner in image.corners])
    middle = (every.min(axis=0) + every.max(axis=0)) / 2
    metres = np.array(metres_per_degree(float(middle[1])))
    extent = np.ptp(every, axis=0) * metres
    scale = SIDE / float(extent.max())
    width, height = (float(v) for v in extent * scale)
    shapes = []
    for k, image in enumerate(images):
        x, y = ((np.array(image.corners) - middle) * metres * scale * (1, -1)).T
        x, y = x + width / 2, y + height / 2
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y))
        colour = SERIES[k % len(SERIES)]
        shapes.append(
            {"name": image.name, "day": image.acquired, "points": points, "colour": colour}
        )
    bar_m = round_length(float(extent[0]) / 4)
    return {
        "width": round(width, 1),
        "height": round(height, 1),
        "shapes": shapes,
        "bar": round(bar_m * scale, 1),
        "bar_m": bar_m,
    }


def _chart(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Pairs with dates by convergence and days, coloured by their quality."""
    dated = [(pair, pair.days) for pair in pairs if pair.days is not None]
    x = Axis(0.0, max([pair.convergence for pair in pairs], default=1.0) * 1.05, WIDTH)
    longest = max([days for _, days in dated], default=1.0) * 1.1
    y = Axis(0.0, max(longest, FIRST_DAY), HEIGHT, turned=True, linear_to=FIRST_DAY)
    points = [
        {
            "x": x.at(pair.convergence),
            "y": y.at(days),
            "colour": to_hex(colormaps[DISPARITIES](pair.matched)),
            "scene": pair.scene,
            "text": f"{pair.left} and {pair.right}: {100 * pair.matched:.0f} %, "
            f"{pair.convergence:.1f} degrees, {days:.2f} days; {pair.reason}",
        }
        for pair, days in dated
    ]
    return {
        "width": WIDTH,
        "height": HEIGHT,
        "points": points,
        "x_ticks": x.ticks(),
        "y_ticks": [(at, text) for at, text in y.ticks() if "." not in text],
        "undated": len(pairs) - len(dated),
    }


def _pairs_table(pairs: Sequence[Pair], page: Path | None) -> Table | None:
    """All pairs; those that are scenes lead to their part of the page."""
    rows = [
        {
            "left": pair.left,
            "right": pair.right,
            "scene": pair.scene,
            "matched_share": f"{pair.matched:.4f}",
            "convergence_degrees": f"{pair.convergence:.1f}",
            "days": "" if pair.days is None else f"{pair.days:.2f}",
            "reason": pair.reason,
        }
        for pair in pairs
    ]
    made = table(rows)
    if made is None or page is None:
        return made
    ((heading, lines),) = made.groups
    at = list(rows[0]).index("scene")
    linked = [
        (*cells[:at], replace(cells[at], href=f"{page}#scene-{pair.scene}"), *cells[at + 1 :])
        if pair.scene
        else cells
        for cells, pair in zip(lines, pairs)
    ]
    return replace(made, groups=((heading, tuple(linked)),))


def _number(value: Any, form: str = ".3f") -> str:
    is_known = isinstance(value, int | float) and math.isfinite(value)
    return format(value, form) if is_known else ""


def _residuals(adjusted: Mapping[str, Any]) -> Table | None:
    """A row per image of the joint adjustment."""
    rows = []
    for name, of in adjusted.get("images", {}).items():
        gcps, ties = of.get("gcps", {}), of.get("ties", {})
        rows.append(
            {
                "image": name,
                "GCPs_used": f"{gcps.get('used', 0)} of {gcps.get('count', 0)}",
                "before_px": _number(gcps.get("before")),
                "after_px": _number(gcps.get("after")),
                "leave_one_out_px": _number(gcps.get("leave_one_out")),
                "tie_points": str(ties.get("used", 0)),
                "disparity_rms_px": _number(ties.get("disparity", {}).get("rms")),
                "y_parallax_rms_px": _number(ties.get("y_parallax", {}).get("rms")),
                "sigma_px": _number(of.get("sigma")),
            }
        )
    return table(rows)


def _remarks(adjusted: Mapping[str, Any]) -> list[str]:
    """Why an image has no correction, and what is odd of it."""
    return [
        f"{name}: {text}"
        for name, of in adjusted.get("images", {}).items()
        for text in ([of["refused"]] if of.get("refused") else []) + list(of.get("doubts", []))
    ]


def _closure(closure: Mapping[str, Any]) -> Table | None:
    """Figures of the labels' closure: of the site, and of each image."""
    of_labels = {"all triplets": closure.get("site", {}).get("labels")}
    of_labels |= {name: of.get("labels") for name, of in closure.get("images", {}).items()}
    return table(
        [
            {
                "triplets of": name,
                "count": str(of["count"]),
                **{f"{key}_px": _number(of.get(key), ".4f") for key in ("median", "rms")},
                "sigma_rms_px": _number(of.get("sigma_rms"), ".4f"),
                "within_1_sigma_share": _number(of.get("within_1_sigma"), ".4f"),
                "within_2_sigma_share": _number(of.get("within_2_sigma"), ".4f"),
            }
            for name, of in of_labels.items()
            if of and of.get("count")
        ]
    )
