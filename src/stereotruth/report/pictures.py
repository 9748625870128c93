"""Pictures of exported tiles as data URIs, each within a given number of bytes."""

from __future__ import annotations

import base64
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import rasterio
from matplotlib import colormaps
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from .. import figures
from ..evaluation.warping import read_tile, warp_tile

Picture = figures.Picture

QUALITIES = (82, 70, 55, 40, 25)  # of WebP; where the last does not fit, the picture shrinks
NO_MATCH = (60, 72, 110)  # pixels without a label, in the warped image
NO_DIFFERENCE = (178, 182, 188)  # and in the difference
GAMMA = 0.75  # of grey pictures: roofs are bright, and the ground is to be seen
DIFFERENCE = 0.12  # of the left image's contrast, at the ends of the colours of a difference
STATUS_COLOURS = {
    "labelled": "#e8f1f8",
    "no_points": "#26262b",
    "hidden_in_left": "#f5a55a",
    "hidden_in_right": "#d1495b",
    "low_correlation": "#6a4c93",
    "changed": "#edd03c",
    "out_of_frame": "#8d99a6",
    "below_minimum_count": "#9c6b4f",
    "edge_in_pixel": "#2a9d8f",
}
OTHER_COLOURS = ("#4c72b0", "#dd8452", "#55a868", "#c44e52", "#937860", "#da8bc3", "#8c8c8c")


@dataclass
class TilePictures:
    """Data URIs of a tile by name, and what their colours mean.

    ``disparity_px``: limits of the colours; ``histogram``: pixels by whole px of disparity;
    ``difference_dn``: limit of the difference's colours in the image's units; ``correlation``
    of left and warped right image.
    """

    uris: dict[str, str]
    disparity_px: tuple[float, float] | None = None
    histogram: dict[int, int] = field(default_factory=dict)
    difference_dn: float | None = None
    correlation: float | None = None


def encode(picture: Picture, limit: int) -> str:
    """A data URI of a grey or RGB picture as WebP of at most ``limit`` bytes.

    Scaled down where even the lowest quality does not fit, then the best quality that fits (one
    pixel always does).
    """
    colour = picture[..., ::-1] if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    data = _webp(colour, QUALITIES[-1])
    while data.size > limit and (side := max(colour.shape[:2])) > 1:
        factor = min(0.9, np.sqrt(limit / data.size))
        colour = figures.shrink(colour, max(1, int(side * factor)))
        data = _webp(colour, QUALITIES[-1])
    better = (_webp(colour, quality) for quality in QUALITIES[:-1])
    data = next((found for found in better if found.size <= limit), data)
    return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")


def _webp(colour: Picture, quality: int) -> NDArray[np.uint8]:
    done, data = cv2.imencode(".webp", colour, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise RuntimeError("OpenCV without WebP")
    return data


def encode_file(path: Path, limit: int, side: int) -> str:
    """A data URI of a picture file, scaled down to ``side`` px at most."""
    return encode(figures.shrink(cv2.imread(str(path))[..., ::-1], side), limit)


def status_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour, #rrggbb, for each reason; reasons that are not known get one of their own."""
    unknown = [name for name in names if name not in STATUS_COLOURS]
    other = {name: OTHER_COLOURS[k % len(OTHER_COLOURS)] for k, name in enumerate(unknown)}
    return {name: STATUS_COLOURS.get(name) or other[name] for name in names}


def gradient(cmap: str, stops: int = 13) -> str:
    """The colours of a matplotlib map as a CSS gradient, left to right."""
    rgb = (colormaps[cmap](np.linspace(0, 1, stops))[:, :3] * 255 + 0.5).astype(int)
    return f"linear-gradient(90deg,{','.join(f'rgb({r},{g},{b})' for r, g, b in rgb)})"


def read_status(path: Path) -> tuple[NDArray[np.uint8], dict[int, str]]:
    """Status values of a tile and what they mean, from the file's description."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            text = dataset.tags().get("TIFFTAG_IMAGEDESCRIPTION", "")
            return dataset.read(1), {int(v): n for v, n in re.findall(r"(\d+) (\w+)", text)}


def _grey(image: NDArray[np.float64], limits: tuple[float, float]) -> Picture:
    lut = np.rint(255.0 * np.linspace(0, 1, 256) ** GAMMA).astype(np.uint8)
    return lut[figures.stretch(image, limits=limits)]


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
    slider: tuple[int, int] | None,
) -> TilePictures:
    """The pictures of one tile; ``row`` is its line of the manifest in ``folder``.

    ``thumbnail``, ``slider``: longer side in px and bytes of each picture; without ``slider``
    there is no warped image and no difference. A pair without labels has its images only.
    """
    folder = Path(folder)
    side, size = thumbnail
    left, right = (read_tile(folder / row[kind]) for kind in ("left", "right"))
    limits = _limits(left)
    result = TilePictures({})
    for name, image in (("left", left), ("right", right)):
        grey = _grey(np.nan_to_num(image), limits if name == "left" else _limits(right))
        result.uris[name] = encode(figures.shrink(grey, side), size)
    if row.get("status"):
        status, names = read_status(folder / row["status"])
        colours = status_colours(list(names.values()))
        table = np.zeros((256, 3), np.uint8)
        for value, name in names.items():
            table[value] = tuple(bytes.fromhex(colours[name][1:]))
        result.uris["status"] = encode(figures.shrink(table[status], side), size)
    if not row.get("disp"):
        return result
    disparity = read_tile(folder / row["disp"])
    known = disparity[np.isfinite(disparity)]
    if known.size:
        low, high = (float(v) for v in np.percentile(known, (1, 99)))
        result.disparity_px = low, high
        values, counts = np.unique(np.floor(known).astype(int), return_counts=True)
        result.histogram = dict(zip(values.tolist(), counts.tolist()))
        coloured = figures.colours(disparity, (low, high))
        result.uris["disparity"] = encode(figures.shrink(coloured, side), size)
    if slider is None or not known.size:
        return result
    side, size = slider
    tile = warp_tile(folder, row)
    sums = tile.sums
    matched = sums.match(tile.warped)
    nothing = ~np.isfinite(matched)
    spread = max(DIFFERENCE * (limits[1] - limits[0]), 1e-9)
    pictures = {
        "slider_left": _grey(tile.left, limits),
        "slider_warped": np.repeat(_grey(np.nan_to_num(matched), limits)[..., None], 3, axis=2),
        "slider_difference": figures.colours(tile.left - matched, (-spread, spread), "RdBu"),
        "slider_disparity": coloured,
    }
    pictures["slider_warped"][nothing] = NO_MATCH
    pictures["slider_difference"][nothing] = NO_DIFFERENCE
    for name, picture in pictures.items():
        result.uris[name] = encode(figures.shrink(picture, side), size)
    result.difference_dn = spread
    result.correlation = sums.coefficient if np.isfinite(sums.coefficient) else None
    return result
