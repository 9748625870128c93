"""Charts of a city's page: tiles on the ground, disparities, stated uncertainties held to truth."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyproj
import rasterio

from ...pages.figures import AXES, Chart, Plot, look, on_the_ground, styled
from ...pages.pictures import SERIES, shrink
from ...pages.tables import minus, missed
from ...tiles.quick_looks import SPLIT_COLOURS, read_footprints

PICTURE_PX = 1000
MARGIN = 0.03  # of the longer side, around all footprints
BARS = 80  # most bars of a histogram
NORMAL = (68.3, 95.4)  # % of normal errors below once and twice their uncertainty


@styled
def tile_map(
    folder: Path, rows: Sequence[Mapping[str, str]], looks: Iterable[Path], limit: int
) -> Chart | None:
    """Footprints of the tiles in ``folder``, ``rows`` of its manifest, north up; None without any.

    ``looks``: georeferenced pictures of the scenes that may lie below, of ``limit`` bytes each; all
    must have one CRS, that of the first. A click leads to the tile.
    """
    rings = {
        name: np.array(one["geometry"]["coordinates"][0])
        for name, one in read_footprints(folder).items()
    }
    rows = [row for row in rows if row["tile"] in rings]
    if not rows:
        return None
    looks = list(looks)
    crs = _crs(looks, rings.values())
    to_map = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
    placed = {row["tile"]: np.stack(to_map.transform(*rings[row["tile"]].T)) for row in rows}
    every = np.hstack(list(placed.values()))
    margin = MARGIN * float(np.ptp(every, axis=1).max())
    west_south, (east, north) = every.min(axis=1) - margin, every.max(axis=1) + margin
    east, north = east - west_south[0], north - west_south[1]
    plot = Plot.of(
        "tiles on the ground",
        "Borders of the left tiles at the heights of their labels. A click leads to the tile.",
        (7.0, 0.9 + 6.4 * min(north / east, 1.6)),
    )
    for file in looks:
        with rasterio.open(file) as dataset:
            if dataset.crs != rasterio.crs.CRS.from_user_input(crs):
                continue
            bands, box = dataset.read(), dataset.bounds
        # transparent where the scene shows nothing: other scenes lie below
        grounded = np.where(bands[3] > 0, bands, np.array([255, 255, 255, 0])[:, None, None])
        picture = np.ascontiguousarray(np.moveaxis(grounded.astype(np.uint8), 0, -1))
        left, bottom, right, top = np.array(box) - np.tile(west_south, 2)
        plot.picture(plot.axis, shrink(picture, PICTURE_PX), (left, right, bottom, top), limit)
    for row in rows:
        x, y = placed[row["tile"]] - west_south[:, None]
        complete, bad = row["complete"] == "yes", bool(missed(row))
        colour = SPLIT_COLOURS.get(row["split"], SPLIT_COLOURS["none"]) if complete else AXES
        (shape,) = plot.axis.fill(x, y, facecolor=(*_rgb(colour), 0.25 if complete else 0.0))
        shape.set(edgecolor="#c0280c" if bad else colour, linewidth=2.5 if bad else 1.5)
        shape.set_linestyle(":" if bad else "-" if complete else "--")
        text = f"{row['tile']}: {row['split']}" + (", misses a limit of quality" if bad else "")
        plot.hover(shape, [text], [f"#tile-{row['tile']}"])
        plot.axis.text(
            float(x[:-1].mean()), float(y[:-1].mean()), row["number"],
            ha="center", va="center", fontsize=9,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.75, "lw": 0},
            color="#10151c",
        )  # fmt: skip
    plot.axis.set(xlim=(0, east), ylim=(0, north))
    on_the_ground(plot.axis)
    return plot.chart([{k: row[k] for k in ("tile", "scene", "split", "complete")} for row in rows])


def _rgb(colour: str) -> tuple[float, ...]:
    return tuple(value / 255 for value in bytes.fromhex(colour[1:]))


def _crs(looks: Sequence[Path], rings: Iterable[np.ndarray]) -> pyproj.CRS:
    """That of the first picture; without one, true distances from the middle of the city."""
    if looks:
        with rasterio.open(looks[0]) as dataset:
            return pyproj.CRS.from_user_input(dataset.crs)
    lon, lat = np.mean([ring.mean(axis=0) for ring in rings], axis=0)
    return pyproj.CRS.from_proj4(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +datum=WGS84 +units=m")


@styled
def histograms(title: str, counted: Mapping[str, Mapping[int, int]]) -> Chart | None:
    """Histograms of labels by whole px, one below the other on one axis of disparities and one of
    shares; None of no labels.

    Columns are joined where there are many; those beyond the permille at either end of all counts
    together are left out of the drawing.
    """
    counted = {name: counts for name, counts in counted.items() if sum(counts.values())}
    total = sum((Counter(counts) for counts in counted.values()), Counter())
    if not total:
        return None
    values = np.array(sorted(total))
    share = np.cumsum([total[v] for v in values.tolist()]) / total.total()
    low, high = values[np.searchsorted(share, (0.001, 0.999))] + np.array([0, 1])
    step = max(1, math.ceil((high - low) / BARS))
    edges = np.arange(low, high + step, step)
    plot = Plot.of(
        title,
        "One axis for all; the last permille at either end is left out.",
        (6.4, 0.7 + 1.25 * len(counted)),
        rows=len(counted),
        sharex=True,
        sharey=True,
    )
    table = []
    for number, ((name, counts), (axis,)) in enumerate(zip(counted.items(), plot.axes)):
        count = sum(counts.values())
        px = np.array(list(counts), float)
        of_all = 100 * np.array(list(counts.values())) / count / step
        shares, _ = np.histogram(px, edges, weights=of_all)
        mean = float(np.sum((px + 0.5) * list(counts.values())) / count)
        axis.stairs(shares, edges, fill=True, color=SERIES[number % len(SERIES)])
        axis.set_title(minus(f"{name}: {count / 1e6:.2f} million labels, mean {mean:.1f} px"))
        axis.set_ylabel("% per px")
        table += [
            {"of": name, "from_px": int(a), "percent_per_px": round(float(s), 5)}
            for a, s in zip(edges, shares)
        ]
        bars = axis.bar(edges[:-1], shares, step, align="edge", alpha=0)
        for bar, a, s in zip(bars, edges, shares):
            plot.hover(bar, [minus(f"{a} to {a + step} px: {s:.2f} % per px")])
    plot.axes[-1][0].set_xlabel("disparity, px")
    return plot.chart(table)


@styled
def calibration(deciles: Sequence[Mapping[str, float]], caption: str) -> Chart | None:
    """Shares of errors below once and twice their uncertainty, by groups of rising uncertainty.

    ``deciles``: of the labels, by their uncertainty; dashed lines stand where it is right.
    """
    if not deciles:
        return None
    plot = Plot.of("errors below their uncertainty", caption, (6.4, 3.4))
    sigma = [of["mean_uncertainty"] for of in deciles]
    for number, (name, key) in enumerate((("once", "share_below_1"), ("twice", "share_below_2"))):
        shares = [100 * of[key] for of in deciles]
        style = look(number) | {"linestyle": "none"}
        (marks,) = plot.axis.plot(range(len(sigma)), shares, label=f"below {name}", **style)
        texts = [f"{s:.3f} px: {share:.1f} % below {name}" for s, share in zip(sigma, shares)]
        plot.hover(marks, texts)
        plot.axis.axhline(NORMAL[number], color=AXES, linestyle="--", linewidth=1)
    plot.axis.set_xticks(range(len(sigma)), [f"{s:.3f}" for s in sigma])
    plot.axis.set(xlabel="uncertainty, px: groups of labels", ylabel="% of the errors")
    plot.axis.set_ylim(0, 103)
    plot.axis.legend(loc="lower right")
    return plot.chart(deciles)
