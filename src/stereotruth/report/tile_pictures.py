"""Pictures of exported tiles as data URIs, each within a given number of bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..dataset.warped_tile import warp_tile
from ..products import pictures
from ..products.pictures import Picture, encode, hillshade
from ..products.rasters import read_flags, read_image, read_tile
from ..status import BY_LABEL
from .relief import Relief

NO_MATCH = (60, 72, 110)  # pixels without a label, in the warped image
NO_DIFFERENCE = (178, 182, 188)  # and in the difference
GAMMA = 0.75  # of grey pictures: roofs are bright, and the ground is to be seen
DIFFERENCE = 0.12  # of the left image's contrast, at the ends of the colours of a difference


@dataclass
class TilePictures:
    """Data URIs of a tile by name, and what they show.

    ``disparity_px``: percentiles 1 and 99 of the labels; ``difference_dn``: limit of the
    difference's colours in the image's units; ``correlation`` of left and warped right image;
    ``relief``: the grid of the 3-D view.
    """

    uris: dict[str, str]
    disparity_px: tuple[float, float] | None = None
    difference_dn: float | None = None
    correlation: float | None = None
    relief: Relief | None = None


@dataclass(frozen=True)
class Large:
    """Of the large pictures of a tile: longer side in px, bytes of each, side of the 3-D grid."""

    side: int
    limit: int
    grid: int


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


def status_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour, #rrggbb, for each reason; reasons that are not known get one of their own."""
    known = {name: BY_LABEL[name].colour for name in names if name in BY_LABEL}
    unknown = [name for name in names if name not in known]
    other = {name: pictures.SERIES[k % len(pictures.SERIES)] for k, name in enumerate(unknown)}
    return known | other


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
    large: Large | None,
    limits_px: tuple[float, float] | None,
    base_to_height: float = 1.0,
) -> TilePictures:
    """The pictures of one tile; ``row`` is its line of the manifest in ``folder``.

    ``thumbnail``: longer side in px and bytes of each picture; without ``large`` there is no
    warped image, no difference, no hillshade and no 3-D view. A pair without labels has its images
    only. ``limits_px``: of the colours of disparity; ``base_to_height``: px of disparity for a px
    of height.
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
    if large is not None:
        shaded = hillshade(disparity, base_to_height)
        _large_pictures(result, folder, row, large, {"disparity": coloured, "hillshade": shaded})
        result.relief = Relief.of(disparity, base_to_height, large.grid)
    return result


def _large_pictures(
    result: TilePictures,
    folder: Path,
    row: Mapping[str, str],
    large: Large,
    layers: Mapping[str, Picture],
) -> None:
    """Add the large pictures, named ``slider_…``: the ``layers``, left, warped, difference."""
    tile = warp_tile(folder, row)
    limits = _limits(tile.left)
    sums = tile.sums
    matched = sums.match(tile.warped)
    nothing = ~np.isfinite(matched)
    spread = max(DIFFERENCE * (limits[1] - limits[0]), 1e-9)
    warped = np.repeat(_shown(np.nan_to_num(matched), limits)[..., None], 3, axis=2)
    warped[nothing] = NO_MATCH
    difference = pictures.colours(tile.left - matched, (-spread, spread), pictures.DIFFERENCES)
    difference[nothing] = NO_DIFFERENCE
    images = {"left": _shown(tile.left, limits), "warped": warped, "difference": difference}
    for name, picture in {**images, **layers}.items():
        result.uris[f"slider_{name}"] = encode(pictures.shrink(picture, large.side), large.limit)
    result.difference_dn = spread
    result.correlation = sums.coefficient if np.isfinite(sums.coefficient) else None
