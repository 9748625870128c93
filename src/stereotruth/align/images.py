"""."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.errors import RasterioError

from ..core.dates import acquisition_time
from ..core.errors import InputError
from ..core.numerics.hull import corners_of_hull
from ..core.products.ungeoreferenced import open_raster
from ..lidar.footprint import Footprint
from ..sensor.acquisition import Acquisition, by_sheet, read_acquisition
from ..sensor.pair_geometry import find_overlap, find_rotation
from ..sensor.rpc import SensorModel
from ..sensor.rpc_files import read_rpc
from ..sensor.site_pairs import SiteImage
from ..sensor.virtual_points import frame, steps
from .align import RPC_SHIFT, RPC_TILT
from .gcp_checks import open_view


@dataclass(frozen=True)
class GivenImage:
    """What the images sheet says: ``acquired`` and ``sun`` (azimuth, elevation) may be None."""

    name: str
    file: Path
    acquired: date | datetime | None
    sun: tuple[float, float] | None

    @classmethod
    def of(
        cls, name: str, file: Path, acquired: str, azimuth: float | None, elevation: float | None
    ) -> GivenImage:
        """From the cells of a row, which have been checked."""
        sun = None if azimuth is None or elevation is None else (float(azimuth), float(elevation))
        return cls(name, file, acquisition_time(acquired) if acquired else None, sun)


def open_image(given: GivenImage) -> tuple[SiteImage, Acquisition]:
    """An image and what its delivery says of it. InputError if it or its RPC cannot be used.

    What the sheet says goes before the delivery.
    """
    sensor, size = open_view(f"site's {given.name}", given.file, "")
    rpc = sensor.rpc
    place = float(rpc.long_off), float(rpc.lat_off)
    delivery = read_acquisition(given.file, place)
    taken = by_sheet(delivery, given.acquired, given.sun, place)
    return SiteImage(given.name, sensor, size, taken.time, taken.sun), delivery


Floats = NDArray[np.float64]
Sizes = tuple[tuple[int, int], tuple[int, int]]

DEVIATIONS = 4.0  # of what RPCs are off
HEIGHT_SHARE = 0.25  # of the RPCs' range of heights, that the ground may lie outside of it
EDGE = 33  # places along each side of a frame
LEVELS = 7  # heights
FARTHEST_LON = 179.0  # degrees: beyond, footprints are not told apart
MOST_DEGREES = 10.0  # along a side of a footprint: more is none of one site


def footprint_of(
    pairs: Iterable[tuple[str | Path, str | Path]], margin_m: float
) -> Footprint | None:
    """The ground of pairs (left and right image) and a margin around it.

    None where an image or its RPC does not tell it: then all points are wanted, and rule align says
    what is wrong.
    """
    try:
        outlines = [o for left, right in pairs for o in pair_outlines(*opened(left, right))]
    except (InputError, RasterioError, OSError, ValueError):
        return None
    every = np.hstack(outlines)
    small = np.ptp(every, axis=1).max() <= MOST_DEGREES
    if not (np.isfinite(every).all() and small and np.abs(every[0]).max() < FARTHEST_LON):
        return None
    return Footprint.around(outlines, margin_m)


def opened(
    left_image: str | Path, right_image: str | Path
) -> tuple[SensorModel, SensorModel, Sizes]:
    """Sensor models and sizes (cols, rows) of both images. Raises what reading them raises."""
    sensors, sizes = [], []
    for image in (left_image, right_image):
        sensors.append(SensorModel(read_rpc(image)))
        with open_raster(image) as dataset:
            sizes.append((dataset.width, dataset.height))
    return sensors[0], sensors[1], (sizes[0], sizes[1])


def pair_outlines(left: SensorModel, right: SensorModel, sizes: Sizes) -> list[Floats]:
    """Convex outlines [2, n], lon and lat in degrees, of what a pair's grid and its images show.

    Raises InputError if the images share no ground.
    """
    low, high = _heights(left, right)
    middle = (low + high) / 2
    overlap = find_overlap(left, right, sizes, middle, (low, high), ("left", "right"))
    turn = find_rotation(left, right, overlap, middle)[0][:, :2]
    heights = steps(low, high, LEVELS, 0.0)
    wide = DEVIATIONS * (RPC_SHIFT + RPC_TILT * max(*sizes[0], *sizes[1]))
    col, row = turn.T @ _rim(*_grid(left, right, sizes, turn, heights, wide))
    grid = []
    for height, other in ((low, high), (high, low)):
        lon, lat = left.localize(col, row, height)
        grid += [(lon, lat), right.localize(*right.project(lon, lat, height), other)]
    outlines = [_hull(grid)]
    for sensor, size in zip((left, right), sizes):
        rim = _rim(np.full(2, -wide), np.array(size) - 1 + wide)
        outlines.append(_hull([sensor.localize(*rim, height) for height in (low, high)]))
    return outlines


def _heights(left: SensorModel, right: SensorModel) -> tuple[float, float]:
    """Ellipsoidal heights (m) between which the ground of a pair lies."""
    boxes = np.array([sensor.rpc.ground_box[4:] for sensor in (left, right)])
    low, high = float(boxes[:, 0].min()), float(boxes[:, 1].max())
    margin = HEIGHT_SHARE * (high - low)
    return low - margin, high + margin


def _grid(
    left: SensorModel,
    right: SensorModel,
    sizes: Sizes,
    turn: Floats,
    heights: Floats,
    wide: float,
) -> tuple[Floats, Floats]:
    """Lowest and highest corner [2] of the pair's epipolar grid, in turned px of the left image.

    What the left frame shares with the right one at any of the heights, as in :func:`.fit._grid`,
    widened by ``wide`` px for what the RPCs may be off.
    """
    col, row = frame(sizes[1], EDGE)
    lon, lat = right.localize(col[:, None], row[:, None], heights[None, :])
    seen = np.stack(left.project(lon, lat, heights[None, :])).reshape(2, -1)
    frames = turn @ np.stack(frame(sizes[0], 2)), turn @ seen[:, np.isfinite(seen).all(axis=0)]
    low = np.maximum(*(each.min(axis=1) for each in frames)) - wide
    high = np.minimum(*(each.max(axis=1) for each in frames)) + wide
    return low, high


def _rim(low: Floats, high: Floats) -> Floats:
    """Places [2, n] along the sides of a box."""
    t = np.linspace(0.0, 1.0, EDGE)
    zero, one = np.zeros(EDGE), np.ones(EDGE)
    x, y = np.concatenate([t, t, zero, one]), np.concatenate([zero, one, t, t])
    return low[:, None] + (high - low)[:, None] * np.stack([x, y])


def _hull(places: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Corners [2, n] of the convex hull of all places that are finite, counterclockwise."""
    ground = np.hstack([np.stack(place) for place in places])
    ground = ground[:, np.isfinite(ground).all(axis=0)]
    if ground.shape[1] < 3:
        raise InputError("lines of sight do not meet the ground")
    return ground[:, corners_of_hull(*ground)]
