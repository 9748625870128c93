"""Images of a pair or a site, opened; the ground of a pair by their RPCs, and sites all over it.

The ground of a pair is that whose LiDAR can have a say in its products, by the RPCs with what they
may be off and the heights that they are made for: labels follow from points that the pair's
epipolar grid shows, and on the rays from there to both cameras; heights of an original image from
what its frame shows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import corners_of_hull, metres_per_degree, turn
from ..core.products.rasters import open_raster
from ..core.tables import acquisition_time
from ..lidar.lattice import Footprint
from ..lidar.point_store import PointStore
from ..sensor.deliveries import Acquisition, by_sheet, read_acquisition
from ..sensor.pair_geometry import GroundOfImages, find_overlap, find_rotation, frame, steps
from ..sensor.rpc import SensorModel
from ..sensor.rpc_files import read_rpc, rpc_file
from ..sensor.site_pairs import SiteImage
from .alignment import RPC_SHIFT, RPC_TILT

Sizes = tuple[tuple[int, int], tuple[int, int]]
Site = tuple[int, int, float, float]  # upper-left col, row px; lowest, highest point in m


DEVIATIONS = 4.0  # of what RPCs are off
HEIGHT_SHARE = 0.25  # of the RPCs' range of heights, that the ground may lie outside of it
EDGE = 33  # places along each side of a frame
LEVELS = 7  # heights
FARTHEST_LON = 179.0  # degrees: beyond, footprints are not told apart
MOST_DEGREES = 10.0  # along a side of a footprint: more is none of one site
SITES = 120  # about; each is read by itself
SITE = 168  # px of the left image, side of a site
MARGIN = 24  # px around a site whose points are looked at
NEAR_DEG = 1e-5  # around a place whose cells tell the heights of its points
NOT_FIRM = (3, 4, 5, 9)  # ASPRS classes: vegetation, and water, which moves
IS_FIRM = ~np.isin(np.arange(256), NOT_FIRM)  # by class
PIXEL_M = (0.01, 1000.0)  # m on the ground
PIXEL_RATIO = 2.0  # of the largest and smallest in an image, over the heights of its RPC
GRID_SHIFT_M = 100.0  # between an image's map grid and its RPC: rounded corners and a loose RPC
GRID_BENT = 0.01  # of the image's diagonal likewise, without the shift


def open_view(name: str, image: Path, of: str) -> tuple[SensorModel, tuple[int, int]]:
    """The RPC of an image and its size (cols, rows).

    Raises InputError: unreadable, or an RPC that does not see the ground by the image's pixels.
    """
    sensor = SensorModel(read_rpc(image))
    try:
        with open_raster(image) as dataset:
            size = dataset.width, dataset.height
            apart = _apart_of_grid(dataset, sensor)
    except RasterioError as error:
        raise InputError(
            f"cannot be opened as the {name} image{of} ({error})",
            file=image,
            remedy="check the file",
        ) from None
    if apart:
        raise InputError(
            f"the {name} image {image.name} is on a map grid and has an RPC, which put its pixels "
            f"{apart:.0f} m apart: it was map-projected, or cut, and kept the RPC from before{of}",
            file=image,
            remedy="give the image as the sensor saw it, with its RPC; if it is that, take the "
            "grid away (gdal_edit.py -unsetgt -a_srs '')",
        )
    if defect := _blindness(sensor, size):
        raise InputError(
            f"the RPC of the {name} image {image.name} cannot be right: {defect}{of}",
            file=rpc_file(image),
            remedy="check that RPC and image belong together, and get the RPC again from the "
            "image's supplier",
        )
    return sensor, size


def _apart_of_grid(dataset: Any, sensor: SensorModel) -> float:
    """Metres by which an image's map grid and its RPC contradict each other; 0 if they do not.

    Images that were projected to a plane (ortho-ready) have RPCs of their own, which agree with the
    grid at one height. Corners of NITF are rounded to a second of arc: GRID_SHIFT_M is allowed.
    """
    if dataset.crs is None or dataset.transform == dataset.transform.identity():
        return 0.0
    try:
        to_degrees = pyproj.Transformer.from_crs(dataset.crs.to_wkt(), 4326, always_xy=True)
    except ProjError:
        return 0.0
    axes = (np.linspace(0, n - 1, 5) for n in (dataset.width, dataset.height))
    col, row = (v.ravel() for v in np.meshgrid(*axes))
    lon, lat = to_degrees.transform(*(dataset.transform * (col + 0.5, row + 0.5)))
    best = np.inf, np.inf
    for share in np.linspace(-1.0, 1.0, 21):
        height = sensor.rpc.height_off + share * sensor.rpc.height_scale
        at = np.array(sensor.localize(col, row, height)) - (lon, lat)
        east, north = np.stack([turn(at[0]), at[1]]) * metres_per_degree(lat)
        whole = np.hypot(east, north)
        bent = np.hypot(east - east.mean(), north - north.mean())
        if np.isfinite(whole).all():
            best = min(best, (float(np.sqrt(np.mean(whole**2))), float(np.sqrt(np.mean(bent**2)))))
    east, north = (np.ptp(v) for v in np.array([lon, lat]) * metres_per_degree(lat))
    is_other = best[0] > GRID_SHIFT_M or best[1] > GRID_BENT * np.hypot(east, north)
    return best[0] if is_other and np.isfinite(best[0]) else 0.0


def _blindness(sensor: SensorModel, size: tuple[int, int]) -> str:
    """Why an RPC cannot be that of an image of this size, or an empty string."""
    rpc = sensor.rpc
    cols, rows = (np.linspace(0, n - 1, 3) for n in size)
    heights = rpc.height_off + rpc.height_scale * np.array([0.0, -1.0, 1.0])
    height, row, col = (a.reshape(3, 9) for a in np.meshgrid(heights, rows, cols, indexing="ij"))
    lon, lat = sensor.localize(col, row, height)
    if not np.isfinite([lon[0], lat[0]]).all():
        return "lines of sight through its middle and corners do not meet the ground"
    sides = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        there = np.array(sensor.localize(col + step[0], row + step[1], height)) - (lon, lat)
        side = np.hypot(*(there * metres_per_degree(lat)))
        sides.append(side[np.isfinite(side)])
        if not (PIXEL_M[0] <= sides[-1].min() and sides[-1].max() <= PIXEL_M[1]):
            return f"its pixels would be {sides[-1].min():.3g} to {sides[-1].max():.3g} m long"
        if sides[-1].max() > PIXEL_RATIO * sides[-1].min():
            return (
                f"its pixels would be {sides[-1].min():.3g} m long here and "
                f"{sides[-1].max():.3g} m there"
            )
    west, south, east, north, low, high = rpc.ground_box
    axes = (np.linspace(*ends, 5) for ends in ((west, east), (south, north), (low, high)))
    terms = rpc.denominators(*(axis.reshape(-1) for axis in np.meshgrid(*axes)))
    if (terms.min(axis=1) * terms.max(axis=1) <= 0).any():
        return "a denominator vanishes within its own ground box"
    return ""


def open_image(
    name: str, file: Path, acquired: str, azimuth: float | None, elevation: float | None
) -> tuple[SiteImage, Acquisition]:
    """An image and what its delivery says of it. InputError if it or its RPC cannot be used.

    What the images sheet says goes before the delivery: the checked cells of the day or time
    (empty: nothing) and of the sun's angles, degrees.
    """
    sensor, size = open_view(f"site's {name}", file, "")
    place = float(sensor.rpc.long_off), float(sensor.rpc.lat_off)
    delivery = read_acquisition(file, place)
    time = acquisition_time(acquired) if acquired else None
    sun = None if azimuth is None or elevation is None else (float(azimuth), float(elevation))
    taken = by_sheet(delivery, time, sun, place)
    return SiteImage(name, sensor, size, taken.time, taken.sun), delivery


def footprint_of(
    pairs: Iterable[tuple[str | Path, str | Path]], margin_m: float
) -> Footprint | None:
    """The ground of pairs (left and right image) and a margin around it.

    None where an image or its RPC does not tell it: then all points are wanted, and rule align says
    what is wrong.
    """
    try:
        opened = [GroundOfImages.open(images) for images in pairs]
        outlines = [o for pair in opened for o in pair_outlines(*pair.sensors, tuple(pair.sizes))]
    except (InputError, RasterioError, OSError, ValueError):
        return None
    every = np.hstack(outlines)
    small = np.ptp(every, axis=1).max() <= MOST_DEGREES
    if not (np.isfinite(every).all() and small and np.abs(every[0]).max() < FARTHEST_LON):
        return None
    return Footprint.around(outlines, margin_m)


def pair_outlines(left: SensorModel, right: SensorModel, sizes: Sizes) -> list[Floats]:
    """Convex outlines [2, n], lon and lat in degrees, of what a pair's grid and its images show.

    Raises InputError if the images share no ground.
    """
    boxes = np.array([sensor.rpc.ground_box[4:] for sensor in (left, right)])
    low, high = float(boxes[:, 0].min()), float(boxes[:, 1].max())
    margin = HEIGHT_SHARE * (high - low)
    low, high = low - margin, high + margin
    middle = (low + high) / 2
    overlap = find_overlap(left, right, sizes, middle, (low, high), ("left", "right"))
    turn = find_rotation(left, right, overlap, middle)[0][:, :2]
    wide = DEVIATIONS * (RPC_SHIFT + RPC_TILT * max(*sizes[0], *sizes[1]))
    # The pair's grid, in turned px of the left image: what its frame shares with the right one at
    # any of the heights, as in :func:`.fit._grid`, wider by what the RPCs may be off.
    heights = steps(low, high, LEVELS, 0.0)[None, :]
    lon, lat = right.localize(*(axis[:, None] for axis in frame(sizes[1], EDGE)), heights)
    seen = np.stack(left.project(lon, lat, heights)).reshape(2, -1)
    frames = turn @ np.stack(frame(sizes[0], 2)), turn @ seen[:, np.isfinite(seen).all(axis=0)]
    first = np.maximum(*(each.min(axis=1) for each in frames)) - wide
    last = np.minimum(*(each.max(axis=1) for each in frames)) + wide
    col, row = turn.T @ _rim(first, last)
    grid = []
    for height, other in ((low, high), (high, low)):
        lon, lat = left.localize(col, row, height)
        grid += [(lon, lat), right.localize(*right.project(lon, lat, height), other)]
    outlines = [_hull(grid)]
    for sensor, size in zip((left, right), sizes):
        rim = _rim(np.full(2, -wide), np.array(size) - 1 + wide)
        outlines.append(_hull([sensor.localize(*rim, height) for height in (low, high)]))
    return outlines


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


def choose_sites(
    left: SensorModel,
    right: SensorModel,
    sizes: Sizes,
    stores: Sequence[PointStore],
    height: float,
) -> list[Site]:
    """(col, row, lowest, highest height in m) of sites: upper-left px in the left image.

    Some SITES squares on a regular grid, apart from each other, over what both images and the
    LiDAR cover. ``height``: about that of the ground, ellipsoidal m; points that lie elsewhere have
    no say.
    """
    cols, rows = sizes[0]
    if min(cols, rows) < SITE:
        return []

    def covered(col: float, row: float) -> tuple[float, float] | None:
        """Range of heights at a left position that LiDAR and right image cover."""
        low = high = height
        for _ in range(3):
            lon, lat = (float(v) for v in left.localize(col, row, (low + high) / 2))
            if not np.isfinite(lon):
                return None
            box = lon - NEAR_DEG, lat - NEAR_DEG, lon + NEAR_DEG, lat + NEAR_DEG
            there = [pair for store in stores if (pair := store.height_range(*box))]
            if not there:
                return None
            low, high = min(pair[0] for pair in there), max(pair[1] for pair in there)
        c, r = right.project(lon, lat, (low + high) / 2)
        return (low, high) if 0 <= c < sizes[1][0] and 0 <= r < sizes[1][1] else None

    def grid(spacing: float) -> list[Site]:
        found = []
        for row in np.arange(spacing / 2, rows, spacing):
            for col in np.arange(spacing / 2, cols, spacing):
                if (heights := covered(col, row)) is not None:
                    corner = (
                        min(max(int(at) - SITE // 2, 0), n - SITE)
                        for at, n in zip((col, row), (cols, rows))
                    )
                    found.append((*corner, *heights))
        return found

    coarse = max(np.sqrt(cols * rows / (2.0 * SITES)), SITE)
    return grid(max(coarse * np.sqrt(max(len(grid(coarse)), 1) / SITES), SITE))


def query_box(left: SensorModel, right: SensorModel, site: Site) -> Floats | None:
    """(west, south, east, north) of all points that either image may show in a site, degrees."""
    col0, row0, low, high = site
    ends = np.array([-MARGIN, SITE + MARGIN])
    corners = [axis.ravel() for axis in np.meshgrid(col0 + ends, row0 + ends)]
    middle = (low + high) / 2
    ground = [left.localize(*corners, z) for z in (low, high)]
    at_right = right.project(*left.localize(*corners, middle), middle)
    ground += [right.localize(*at_right, z) for z in (low, high)]
    ground = np.hstack([np.stack(g) for g in ground])
    if not np.isfinite(ground).all():
        return None
    return np.concatenate([ground.min(axis=1), ground.max(axis=1)])
