"""Pictures of exported tiles as data URIs, each within a given number of bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.products.rasters import read_flags, read_image, read_tile
from ...pages import pictures
from ...pages.pictures import Layer, Picture, Scale, encode, hillshade
from ...pages.tables import minus
from ...tiles.quick_looks import status_colours
from ...tiles.tile_checks import warp_tile

NO_MATCH = (60, 72, 110)  # pixels without a label, in the warped image
GAMMA = 0.75  # of grey pictures: roofs are bright, and the ground is to be seen
DIFFERENCE = 0.12  # of the left image's contrast, at the ends of the colours of a difference


LARGE = ("left", "warped right", "left − warped right", "disparity", "hillshade")


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
    total: Counter[int] = Counter()
    for counts in counted:
        total.update(counts)
    if not total:
        return None
    values = np.array(sorted(total))
    share = np.cumsum([total[v] for v in values.tolist()]) / total.total()
    low, high = values[np.searchsorted(share, (0.01, 0.99))].tolist()
    return float(low), float(high + 1)


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
