"""The map of a city's tiles on the ground: footprints, north up, over the left images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray

from ..dataset.footprints import read_footprints
from ..dataset.quick_looks import SPLIT_COLOURS
from ..pages.tables import missed
from ..pages.pictures import encode, round_length, shrink

SIDE = 1000.0  # longer side of the drawing
PICTURE_PX = 1000
MARGIN = 0.03  # of the longer side, around all footprints


@dataclass(frozen=True)
class Background:
    """A picture as a data URI, and where it lies in the drawing."""

    uri: str
    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Footprint:
    """A tile in the drawing: ``points`` of its border, ``x``, ``y`` of its middle."""

    tile: str
    number: str
    points: str
    x: float
    y: float
    size: float
    colour: str
    complete: bool
    bad: bool


@dataclass(frozen=True)
class GroundMap:
    """Footprints north up, in the units of an SVG view box (y down); a bar for the scale."""

    width: float
    height: float
    pictures: tuple[Background, ...]
    tiles: tuple[Footprint, ...]
    bar: float
    bar_m: float


def ground_map(
    folder: Path, rows: Sequence[Mapping[str, str]], looks: Iterable[Path], limit: int
) -> GroundMap | None:
    """The map of the tiles in ``folder``, ``rows`` of its manifest; None without footprints.

    ``looks``: georeferenced pictures of the scenes that may lie below; all must have one CRS, that
    of the first. ``limit``: bytes of each.
    """
    rings = {
        name: np.array(one["geometry"]["coordinates"][0])
        for name, one in read_footprints(folder).items()
    }
    shown = [row for row in rows if row["tile"] in rings]
    if not shown:
        return None
    looks = list(looks)
    to_map = pyproj.Transformer.from_crs(4326, _crs(looks, rings.values()), always_xy=True)
    placed = {name: np.stack(to_map.transform(*ring.T)) for name, ring in rings.items()}
    every = np.hstack([placed[row["tile"]] for row in shown])
    margin = MARGIN * float(np.ptp(every, axis=1).max())
    (west, south), (east, north) = every.min(axis=1) - margin, every.max(axis=1) + margin
    scale = SIDE / max(east - west, north - south)

    def at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.round([(x - west) * scale, (north - y) * scale], 1)

    tiles = []
    for row in shown:
        x, y = at(*placed[row["tile"]])
        tiles.append(
            Footprint(
                tile=row["tile"],
                number=row["number"],
                points=" ".join(f"{a:g},{b:g}" for a, b in zip(x, y)),
                x=round(float(x[:-1].mean()), 1),
                y=round(float(y[:-1].mean()), 1),
                size=round(float(np.ptp(x)), 1),
                colour=SPLIT_COLOURS.get(row["split"], SPLIT_COLOURS["none"]),
                complete=row["complete"] == "yes",
                bad=bool(missed(row)),
            )
        )
    pictures = []
    for look in looks:
        with rasterio.open(look) as dataset:
            if dataset.crs != rasterio.crs.CRS.from_user_input(to_map.target_crs):
                continue
            bands, box = dataset.read(), dataset.bounds
        # transparent where the scene shows nothing: other scenes lie below
        grounded = np.where(bands[3] > 0, bands, np.array([255, 255, 255, 0])[:, None, None])
        picture = np.moveaxis(grounded.astype(np.uint8), 0, -1)
        (left, right), (top, bottom) = at(
            np.array([box.left, box.right]), np.array([box.top, box.bottom])
        ).tolist()
        uri = encode(shrink(np.ascontiguousarray(picture), PICTURE_PX), limit)
        pictures.append(Background(uri, left, top, right - left, bottom - top))
    bar_m = round_length((east - west) / 4)
    return GroundMap(
        width=round((east - west) * scale, 1),
        height=round((north - south) * scale, 1),
        pictures=tuple(pictures),
        tiles=tuple(tiles),
        bar=round(bar_m * scale, 1),
        bar_m=bar_m,
    )


def _crs(looks: Sequence[Path], rings: Iterable[NDArray[np.float64]]) -> pyproj.CRS:
    """That of the first picture; without one, true distances from the middle of the city."""
    if looks:
        with rasterio.open(looks[0]) as dataset:
            return pyproj.CRS.from_user_input(dataset.crs)
    lon, lat = np.mean([ring.mean(axis=0) for ring in rings], axis=0)
    return pyproj.CRS.from_proj4(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +datum=WGS84 +units=m")
