"""Pictures of exported tiles as data URIs, each within a given number of bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..dataset.warped_tile import warp_tile
from ..products import pictures
from ..products.pictures import Picture, encode
from ..products.rasters import read_flags, read_image, read_tile

NO_MATCH = (60, 72, 110)  # pixels without a label, in the warped image
NO_DIFFERENCE = (178, 182, 188)  # and in the difference
GAMMA = 0.75  # of grey pictures: roofs are bright, and the ground is to be seen
DIFFERENCE = 0.12  # of the left image's contrast, at the ends of the colours of a difference
STATUS_COLOURS = {  # apart for all eyes, and what carries a label light
    "labelled": "#eef3f7",
    "no_points": "#1c1c22",
    "hidden_in_left": "#d09230",
    "hidden_in_right": "#a2006a",
    "low_correlation": "#5e41ed",
    "changed": "#effa51",
    "out_of_frame": "#b7928d",
    "masked": "#172d93",
    "below_minimum_count": "#6a6028",
    "edge_in_pixel": "#2183d5",
    "labelled_between": "#aab1dc",
    "labelled_by_images": "#ffe9b8",
    "labelled_crown": "#bfe3c0",
    "too_uncertain": "#3f7d4f",
}


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


def status_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour, #rrggbb, for each reason; reasons that are not known get one of their own."""
    unknown = [name for name in names if name not in STATUS_COLOURS]
    other = {name: pictures.SERIES[k % len(pictures.SERIES)] for k, name in enumerate(unknown)}
    return {name: STATUS_COLOURS.get(name) or other[name] for name in names}


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
    slider: tuple[int, int] | None,
) -> TilePictures:
    """The pictures of one tile; ``row`` is its line of the manifest in ``folder``.

    ``thumbnail``, ``slider``: longer side in px and bytes of each picture; without ``slider``
    there is no warped image and no difference. A pair without labels has its images only.
    """
    folder = Path(folder)
    side, size = thumbnail
    left, right = (read_image(folder / row[kind]).astype(np.float64) for kind in ("left", "right"))
    limits = _limits(left)
    result = TilePictures({})
    for name, image in (("left", left), ("right", right)):
        shown = _shown(image, limits if name == "left" else _limits(right))
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
    if known.size:
        low, high = (float(v) for v in np.percentile(known, (1, 99)))
        result.disparity_px = low, high
        values, counts = np.unique(np.floor(known).astype(int), return_counts=True)
        result.histogram = dict(zip(values.tolist(), counts.tolist()))
        coloured = pictures.colours(disparity, (low, high))
        result.uris["disparity"] = encode(pictures.shrink(coloured, side), size)
    if slider is None or not known.size:
        return result
    side, size = slider
    tile = warp_tile(folder, row)
    sums = tile.sums
    matched = sums.match(tile.warped)
    nothing = ~np.isfinite(matched)
    spread = max(DIFFERENCE * (limits[1] - limits[0]), 1e-9)
    large = {
        "slider_left": _shown(left, limits),
        "slider_warped": np.repeat(_shown(np.nan_to_num(matched), limits)[..., None], 3, axis=2),
        "slider_difference": pictures.colours(
            tile.left - matched, (-spread, spread), pictures.DIFFERENCES
        ),
        "slider_disparity": coloured,
    }
    large["slider_warped"][nothing] = NO_MATCH
    large["slider_difference"][nothing] = NO_DIFFERENCE
    for name, picture in large.items():
        result.uris[name] = encode(pictures.shrink(picture, side), size)
    result.difference_dn = spread
    result.correlation = sums.coefficient if np.isfinite(sums.coefficient) else None
    return result
