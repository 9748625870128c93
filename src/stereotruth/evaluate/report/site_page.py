"""The page of a site: where its images lie, its pairs by quality, residuals by image, closure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.numerics.geometry import metres_per_degree
from ...core.products.rasters import read_overview
from ...pages.figures import AXES, Chart, Plot, look, on_the_ground, styled
from ...pages.page import way, write_page
from ...pages.pictures import DISPARITIES, Scale, encode, stretch
from ...pages.tables import Cell, Table, cells_of, table, words
from ...sensor.pair_geometry import ray_upwards
from ...sensor.site_pairs import Links, RatedPair, SiteImage

TEMPLATE = Path(__file__).with_name("site_page.html.jinja")
LOOK_PX, LOOK_BYTES = 160, 6_000  # of an image's picture
FIRST_DAY = 1.0  # below it, the axis of days is linear


def write_site_page(
    city: str,
    images: Sequence[SiteImage],
    pairs: Sequence[RatedPair],
    out: str | Path,
    *,
    files: Mapping[str, str | Path],
    scenes: Mapping[str, Sequence[str]],
    adjusted: Mapping[str, Any],
    closure: Mapping[str, Any],
    page: str | Path | None,
    index: str | Path | None,
) -> None:
    """Write the page of a site to ``out``.

    ``pairs``: best first; ``files``: of the images, by name; ``scenes``: names of the images of
    each, in any order; ``adjusted``, ``closure``: records of ``results/adjust`` and
    ``results/closure``, empty if there are none; ``page``: of the city's scenes and tiles, None
    if there is none; ``index``: of all pages.
    """
    names = {frozenset(pair): scene for scene, pair in scenes.items()}
    rows = _pair_rows(pairs, names)
    made = [pair.names for pair in pairs if frozenset(pair.names) in names]
    links = {scene: f"{way(out, page)}#scene-{scene}" for scene in scenes}
    values = {
        "city": city,
        "index": way(out, index),
        "page": way(out, page),
        "map": _map(images),
        "chart_of_pairs": _chart(rows, way(out, page)),
        "images": _images_table(images, files),
        "pairs": table(rows, links={"scene": links if page else {}}),
        "counts": (len(images), len(pairs), len(made)),
        "residuals": _residuals(adjusted),
        "remarks": _remarks(adjusted),
        "closure": _closure(closure),
        "qualities": Scale.of(DISPARITIES, "0", "100 % matched"),
        "unlinked": Links.of((image.name for image in images), made).sentences,
    }
    write_page(out, TEMPLATE, values)


def _pair_rows(
    pairs: Sequence[RatedPair], scenes: Mapping[frozenset[str], str]
) -> list[dict[str, str]]:
    """Rows of the pairs: angles, days, what each promises, the scene that is made of it."""
    return [
        {
            "left": one.pair.left,
            "right": one.pair.right,
            "scene": scenes.get(frozenset(one.names), ""),
            "bits_of_height": f"{one.quality.bits:.1f}",
            "matched_share": f"{one.quality.matched:.4f}",
            "height_sigma_m": f"{one.quality.height_sigma_m:.2f}",
            "height_of_1_px_m": f"{one.pair.metres_per_px:.2f}",
            "convergence_degrees": f"{one.pair.convergence:.1f}",
            "suns_apart_degrees": _number(one.pair.sun, ".1f"),
            "days": "" if one.pair.days is None else f"{one.pair.days:.2f}",
            "reason": one.quality.reason,
        }
        for one in pairs
    ]


def _corners(image: SiteImage) -> np.ndarray:
    """[4, (lon, lat)] degrees, at the height of the image's RPC."""
    cols, rows = image.size
    lon, lat = image.sensor.localize(
        np.array([0.0, cols - 1.0, cols - 1.0, 0.0]),
        np.array([0.0, 0.0, rows - 1.0, rows - 1.0]),
        float(image.sensor.rpc.height_off),
    )
    return np.stack([lon, lat], axis=1)


def _acquired(image: SiteImage) -> str:
    return "" if image.time is None else f"{image.time:%Y-%m-%d %H:%M}"


@styled
def _map(images: Sequence[SiteImage]) -> Chart:
    """Footprints, north up, in metres from their south-west corner."""
    corners = {image.name: _corners(image) for image in images}
    every = np.concatenate(list(corners.values()))
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
        x, y = ((corners[image.name] - corner) * metres).T
        style = look(k)
        (shape,) = plot.axis.fill(x, y, facecolor="none", edgecolor=style["color"], linewidth=1.6)
        shape.set(linestyle=style["linestyle"], label=image.name)
        plot.hover(shape, [f"{image.name} {_acquired(image)}".strip()])
        table += [
            {"image": image.name, "lon": f"{lon:.7f}", "lat": f"{lat:.7f}"}
            for lon, lat in corners[image.name]
        ]
    on_the_ground(plot.axis)
    if len(images) <= 6:
        plot.figure.legend(loc="outside lower center", ncols=3)
    return plot.chart(table)


@styled
def _chart(rows: Sequence[Mapping[str, str]], page: str | None) -> Chart | None:
    """Pairs with dates by convergence and days, coloured by their quality; scenes are squares."""
    dated = [row for row in rows if row["days"]]
    if not dated:
        return None
    undated = len(rows) - len(dated)
    more = f" Without dates, so in the table alone: {undated}." if undated else ""
    plot = Plot.of(
        "pairs by convergence and days",
        "Colour: predicted share of the pixels seen in both images that matching finds within "
        f"1 px. Large squares are scenes.{more}",
        (6.4, 4.4),
    )
    for is_scene, marker, size in ((False, "o", 36), (True, "s", 90)):
        of = [row for row in dated if bool(row["scene"]) == is_scene]
        if not of:
            continue
        convergence, days, matched = (
            [float(row[name]) for row in of]
            for name in ("convergence_degrees", "days", "matched_share")
        )
        marks = plot.axis.scatter(
            convergence, days, s=size, marker=marker, c=matched,
            cmap=DISPARITIES, vmin=0, vmax=1, edgecolors=AXES, linewidths=1.2,
        )  # fmt: skip
        texts = [
            f"{row['scene'] + ': ' if is_scene else ''}{row['left']} and {row['right']}: "
            f"{100 * float(row['matched_share']):.0f} %, {row['convergence_degrees']}°, "
            f"{row['days']} days; {row['reason']}"
            for row in of
        ]
        links = [f"{page}#scene-{row['scene']}" if page and is_scene else "" for row in of]
        plot.hover(marks, texts, links)
    plot.axis.set_yscale("symlog", linthresh=FIRST_DAY)
    plot.axis.set(xlabel="convergence, degrees", ylabel="days apart", xlim=(0, None))
    longest = max(float(row["days"]) for row in dated)
    plot.axis.set_ylim(-0.2, 1.5 * max(longest, FIRST_DAY))
    plot.axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    return plot.chart(dated)


def _images_table(images: Sequence[SiteImage], files: Mapping[str, str | Path]) -> Table | None:
    """What each image shows, when and from where it was taken; angles at its middle."""
    rows, looks = [], []
    for image in images:
        cols, lines = image.size
        middle = (cols - 1) / 2, (lines - 1) / 2, float(image.sensor.rpc.height_off)
        upwards = float(ray_upwards(image.sensor, *middle)[2])
        picture = encode(stretch(read_overview(files[image.name], LOOK_PX)), LOOK_BYTES)
        looks.append(Cell(f"picture of {image.name}", "", pictures=(picture,)))
        rows.append(
            {
                "image": image.name,
                "acquired (UTC)": _acquired(image),
                "off_nadir_degrees": f"{math.degrees(math.acos(min(upwards, 1.0))):.1f}",
                "sun_azimuth_degrees": _number(image.sun and image.sun[0], ".1f"),
                "sun_elevation_degrees": _number(image.sun and image.sun[1], ".1f"),
            }
        )
    lines = [(look, *cells_of(row, row)) for look, row in zip(looks, rows)]
    return Table.of(["picture", *map(words, rows[0])], lines, words=(0, 1, 2)) if rows else None


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
