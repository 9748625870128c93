"""The page of a site: where its images lie, its pairs by quality, residuals by image, closure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..epipolar import site_pairs
from ..epipolar.linked_images import Links
from ..epipolar.pair_geometry import ray_upwards
from ..epipolar.pair_quality import rate
from ..numerics.degrees import metres_per_degree
from ..pages.figures import AXES, Chart, Plot, look, styled
from ..pages.page import way, write_page
from ..pages.pictures import DISPARITIES, Scale
from ..pages.tables import Table, table
from .maps import on_the_ground

TEMPLATE = Path(__file__).with_name("site_page.html.jinja")
FIRST_DAY = 1.0  # below it, the axis of days is linear


@dataclass(frozen=True)
class SiteImage:
    """An image: when it was taken (text), its corners on the ground as (lon, lat) degrees.

    ``off_nadir``: angle of its middle ray to the vertical, degrees; ``sun``: azimuth and elevation,
    degrees, None where nothing tells them.
    """

    name: str
    acquired: str
    corners: Sequence[tuple[float, float]]
    off_nadir: float | None = None
    sun: tuple[float, float] | None = None


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
    middle = (cols - 1) / 2, (rows - 1) / 2, float(image.sensor.rpc.height_off)
    upwards = float(ray_upwards(image.sensor, *middle)[2])
    acquired = "" if image.time is None else f"{image.time:%Y-%m-%d %H:%M}"
    off_nadir = math.degrees(math.acos(min(upwards, 1.0)))
    return SiteImage(image.name, acquired, corners, off_nadir, image.sun)


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
        "chart_of_pairs": _chart(pairs, way(out, page)),
        "images": _images_table(images),
        "pairs": _pairs_table(pairs, way(out, page)),
        "counts": (len(images), len(pairs), sum(bool(pair.scene) for pair in pairs)),
        "residuals": _residuals(adjusted),
        "remarks": _remarks(adjusted),
        "closure": _closure(closure),
        "qualities": Scale.of(DISPARITIES, "0", "100 % matched"),
        "unlinked": _unlinked(images, pairs),
    }
    write_page(out, TEMPLATE, values)


def _unlinked(images: Sequence[SiteImage], pairs: Sequence[Pair]) -> list[str]:
    """Images that no scene uses, and groups that none links."""
    made = [(pair.left, pair.right) for pair in pairs if pair.scene]
    return Links.of((image.name for image in images), made).sentences


@styled
def _map(images: Sequence[SiteImage]) -> Chart:
    """Footprints, north up, in metres from their south-west corner."""
    every = np.array([corner for image in images for corner in image.corners])
    corner = every.min(axis=0)
    metres = np.array(metres_per_degree(float(every[:, 1].mean())))
    east, north = np.ptp(every, axis=0) * metres
    plot = Plot.of(
        "footprints of the images",
        "Footprints at the height of each image's RPC; names on hover.",
        (5.6, 1.2 + 4.6 * min(north / east, 1.6) + 0.17 * min(len(images), 6)),
    )
    table = []
    for k, image in enumerate(images):
        x, y = ((np.array(image.corners) - corner) * metres).T
        style = look(k)
        (shape,) = plot.axis.fill(x, y, facecolor="none", edgecolor=style["color"], linewidth=1.6)
        shape.set(linestyle=style["linestyle"], label=image.name)
        plot.hover(shape, [f"{image.name} {image.acquired}".strip()])
        table += [
            {"image": image.name, "lon": f"{lon:.7f}", "lat": f"{lat:.7f}"}
            for lon, lat in image.corners
        ]
    on_the_ground(plot.axis)
    if len(images) <= 6:
        plot.figure.legend(loc="outside lower center", ncols=3)
    return plot.chart(table)


@styled
def _chart(pairs: Sequence[Pair], page: str | None) -> Chart | None:
    """Pairs with dates by convergence and days, coloured by their quality; scenes are squares."""
    dated = [pair for pair in pairs if pair.days is not None]
    if not dated:
        return None
    undated = len(pairs) - len(dated)
    more = f" Without dates, so in the table alone: {undated}." if undated else ""
    plot = Plot.of(
        "pairs by convergence and days",
        "Colour: predicted share of the pixels seen in both images that matching finds within "
        f"1 px. Large squares are scenes.{more}",
        (6.4, 4.4),
    )
    for is_scene, marker, size in ((False, "o", 36), (True, "s", 90)):
        of = [pair for pair in dated if bool(pair.scene) == is_scene]
        if not of:
            continue
        marks = plot.axis.scatter(
            [pair.convergence for pair in of],
            [pair.days for pair in of],
            s=size, marker=marker, c=[pair.matched for pair in of],
            cmap=DISPARITIES, vmin=0, vmax=1, edgecolors=AXES, linewidths=1.2,
        )  # fmt: skip
        texts = [
            f"{pair.scene + ': ' if pair.scene else ''}{pair.left} and {pair.right}: "
            f"{100 * pair.matched:.0f} %, {pair.convergence:.1f}°, {pair.days:.2f} days; "
            f"{pair.reason}"
            for pair in of
        ]
        links = [f"{page}#scene-{pair.scene}" if page and pair.scene else "" for pair in of]
        plot.hover(marks, texts, links)
    plot.axis.set_yscale("symlog", linthresh=FIRST_DAY)
    plot.axis.set(xlabel="convergence, degrees", ylabel="days apart", xlim=(0, None))
    plot.axis.set_ylim(-0.2, None)
    return plot.chart([vars(pair) for pair in dated])


def _images_table(images: Sequence[SiteImage]) -> Table | None:
    """When and from where each image was taken."""
    rows = [
        {
            "image": image.name,
            "acquired (UTC)": image.acquired,
            "off_nadir_degrees": _number(image.off_nadir, ".1f"),
            "sun_azimuth_degrees": _number(image.sun and image.sun[0], ".1f"),
            "sun_elevation_degrees": _number(image.sun and image.sun[1], ".1f"),
        }
        for image in images
    ]
    return table(rows)


def _pairs_table(pairs: Sequence[Pair], page: str | None) -> Table | None:
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
    scenes = [pair.scene for pair in pairs if pair.scene] if page else []
    return table(rows, links={"scene": {scene: f"{page}#scene-{scene}" for scene in scenes}})


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
