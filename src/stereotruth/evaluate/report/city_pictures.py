"""Charts of a city's page, and pictures of its tiles as data URIs of a given number of bytes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from ...core.products.rasters import read_flags, read_image, read_tile
from ...pages import pictures
from ...pages.figures import AXES, Chart, Plot, look, on_the_ground, styled
from ...pages.pictures import SERIES, Layer, Picture, Scale, encode, hillshade, shrink
from ...pages.tables import minus, missed
from ...tiles.quick_looks import SPLIT_COLOURS, read_footprints, status_colours
from ...tiles.tile_checks import warp_tile

PICTURE_PX = 1000
MARGIN = 0.03  # of the longer side, around all footprints
BARS = 80  # most bars of a histogram
NORMAL = (68.3, 95.4)  # % of normal errors below once and twice their uncertainty

NO_MATCH = (60, 72, 110)  # pixels without a label, in the warped image
GAMMA = 0.75  # of grey pictures: roofs are bright, and the ground is to be seen
DIFFERENCE = 0.12  # of the left image's contrast, at the ends of the colours of a difference

LARGE = ("left", "warped right", "left − warped right", "disparity", "hillshade")


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
        (shape,) = plot.axis.fill(x, y, facecolor=(*to_rgb(colour), 0.25 if complete else 0.0))
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
    low, high = _bounds(total, 0.001)
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


@dataclass
class TilePictures:
    """Data URIs of a tile's thumbnails by name, and what they show.

    ``disparity_px``: percentiles 1 and 99 of the labels; ``layers``: large pictures, ``LARGE``, to
    be laid over each other; ``correlation`` of left and warped right image.
    """

    uris: dict[str, str]
    disparity_px: tuple[float, float] | None = None
    layers: dict[str, Layer] = field(default_factory=dict)
    correlation: float | None = None


def disparity_counts(folder: Path, row: Mapping[str, str]) -> Counter[int]:
    """Labels of a tile by whole px of disparity; none of a pair without labels."""
    if not row.get("disp"):
        return Counter()
    disparity = read_tile(folder / row["disp"])
    values, counts = np.unique(
        np.floor(disparity[np.isfinite(disparity)]).astype(int), return_counts=True
    )
    return Counter(dict(zip(values.tolist(), counts.tolist())))


def disparity_limits(counted: Iterable[Mapping[int, int]]) -> tuple[float, float] | None:
    """The whole px that hold all labels of all tiles but a hundredth at either end."""
    total = sum(map(Counter, counted), Counter())
    return _bounds(total, 0.01) if total else None


def _bounds(counts: Counter[int], beyond: float) -> tuple[int, int]:
    """The whole px that hold all that is counted but a share at either end."""
    values = np.array(sorted(counts))
    share = np.cumsum([counts[v] for v in values.tolist()]) / counts.total()
    low, high = values[np.searchsorted(share, (beyond, 1 - beyond))].tolist()
    return low, high + 1


def _shown(image: NDArray[np.float64], limits: tuple[float, float]) -> Picture:
    lut = np.rint(255.0 * np.linspace(0, 1, 256) ** GAMMA).astype(np.uint8)
    return lut[pictures.stretch(image, limits=limits)]


def _limits(image: NDArray[np.float64]) -> tuple[float, float]:
    """Percentiles 1 and 99 of what is known."""
    known = image[np.isfinite(image) & (image != 0)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99))
    return float(low), float(high)


def tile_pictures(
    folder: str | Path,
    row: Mapping[str, str],
    *,
    thumbnail: tuple[int, int],
    large: tuple[int, int] | None,
    limits_px: tuple[float, float] | None,
    base_to_height: float = 1.0,
) -> TilePictures:
    """The pictures of one tile; ``row`` is its line of the manifest in ``folder``.

    ``thumbnail``, ``large``: longer side in px and bytes of each picture; without ``large`` there
    are no ``layers``. A pair without labels has its images only. ``limits_px``: of the colours of
    disparity; ``base_to_height``: px of disparity for a px of height.
    """
    folder = Path(folder)
    side, size = thumbnail
    left, right = (read_image(folder / row[kind]).astype(np.float64) for kind in ("left", "right"))
    result = TilePictures({})
    for name, image in (("left", left), ("right", right)):
        shown = _shown(image, _limits(image))
        result.uris[name] = encode(pictures.shrink(shown, side), size)
    if row.get("status"):
        status, names = read_flags(folder / row["status"])
        colours = status_colours(list(names.values()))
        table = np.zeros((256, 3), np.uint8)
        for value, name in names.items():
            table[value] = tuple(bytes.fromhex(colours[name][1:]))
        result.uris["status"] = encode(pictures.shrink(table[status], side), size)
    if not row.get("disp"):
        return result
    disparity = read_tile(folder / row["disp"])
    known = disparity[np.isfinite(disparity)]
    if not known.size:
        return result
    low, high = (float(v) for v in np.percentile(known, (1, 99)))
    result.disparity_px = low, high
    coloured = pictures.colours(disparity, limits_px)
    result.uris["disparity"] = encode(pictures.shrink(coloured, side), size)
    if large is not None and limits_px is not None:
        ends = (minus(f"{value:.0f} px") for value in limits_px)
        layers = {
            "disparity": (coloured, Scale.of(pictures.DISPARITIES, *ends)),
            "hillshade": (hillshade(disparity, base_to_height), None),
        }
        _add_large(result, folder, row, large, layers)
    return result


def _add_large(
    result: TilePictures,
    folder: Path,
    row: Mapping[str, str],
    large: tuple[int, int],
    layers: Mapping[str, tuple[Picture, Scale | None]],
) -> None:
    """Add the large pictures: left, warped, difference, and the ``layers``."""
    tile = warp_tile(folder, row)
    low, high = _limits(tile.left)
    matched = tile.sums.match(tile.warped)
    nothing = ~np.isfinite(matched)
    spread = max(DIFFERENCE * (high - low), 1e-9)
    warped = np.repeat(_shown(np.nan_to_num(matched), (low, high))[..., None], 3, axis=2)
    warped[nothing] = NO_MATCH
    difference = pictures.colours(tile.left - matched, (-spread, spread), pictures.DIFFERENCES)
    scale = Scale.of(pictures.DIFFERENCES, f"−{spread:.0f} DN", f"+{spread:.0f} DN")
    made = {
        "left": (_shown(tile.left, (low, high)), None),
        "warped right": (warped, None),
        "left − warped right": (difference, scale),
        **layers,
    }
    side, limit = large
    result.layers = {
        name: Layer(encode(pictures.shrink(picture, side), limit), scale)
        for name, (picture, scale) in made.items()
    }
    correlation = tile.sums.coefficient
    result.correlation = correlation if np.isfinite(correlation) else None
