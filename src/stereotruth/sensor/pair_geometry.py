"""How images look at the ground: what one shows, what two see alike, at which angle, along which
direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import InputError
from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.geometry import exact_metres_per_degree
from .rpc import SensorModel

MIN_CONVERGENCE = 1.0  # degrees
LEAST_BASE = 1e-5  # difference of two unit rays; with less, both images look from one place
ALONG_TRACK = 0.7  # share of the base that lies along the flight, at least
SPARE_PX = 64.0  # by which frames are taken wider: RPCs as delivered are off by some ten pixels


def steps(low: float, high: float, n: int, inset: float) -> Floats:
    """n equal steps from low to high, drawn in by a share of the range at both ends."""
    return low + (high - low) * np.linspace(inset, 1 - inset, n)


def frame(size: tuple[int, int], n: int) -> tuple[Floats, Floats]:
    """(col, row) of an n × n grid over an image of (cols, rows) px, edges included."""
    col, row = np.meshgrid(np.linspace(0, size[0] - 1, n), np.linspace(0, size[1] - 1, n))
    return col.ravel(), row.ravel()


def inside(image: Floats, size: tuple[int, int]) -> Bools:
    """Which image points [2, n] lie in the frame of an image of (cols, rows) px."""
    limit = np.array(size)[:, None] - 0.5
    return ((image >= -0.5) & (image <= limit)).all(axis=0)


def find_overlap(
    left: SensorModel,
    right: SensorModel,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    reference: float,
    height_range: tuple[float, float],
    names: tuple[str, str],
) -> Floats:
    """(col, row) [2, n] of left pixels whose ground at the reference height the right image sees.

    If there are none at that height, those of the nearest height in the range that has some.
    """
    col, row = frame(sizes[0], 41)
    heights = sorted({reference, *steps(*height_range, 21, 0.0)}, key=lambda h: abs(h - reference))
    for height in heights:
        lon, lat = left.localize(col, row, height)
        if height == reference and not np.isfinite(lon).any():
            raise InputError(
                "no pixel can be located on the ground by the RPC",
                file=names[0],
                remedy="check that the RPC belongs to this image",
            )
        seen = inside(np.array(right.project(lon, lat, height)), sizes[1])
        if seen.any():
            return np.stack([col[seen], row[seen]])
    raise InputError(
        f"left and right image do not overlap between {height_range[0]:.0f} and "
        f"{height_range[1]:.0f} m (other image: {names[1]})",
        file=names[0],
        remedy="check that both images are of one pair and that each RPC belongs to its image",
    )


def ray_upwards(sensor: SensorModel, col: float, row: float, height: float) -> Floats:
    """Unit vector (east, north, up) of a pixel's ray, upwards, near an ellipsoidal height in m."""
    lon, lat = sensor.localize([col, col], [row, row], [height, height + 200.0])
    east, north = exact_metres_per_degree(lat[0], height)
    ray = np.array([(lon[1] - lon[0]) * east, (lat[1] - lat[0]) * north, 200.0])
    return ray / np.linalg.norm(ray)


def middle_rays(
    left: SensorModel, right: SensorModel, overlap: Floats, height: float
) -> tuple[Floats, Floats]:
    """Unit vectors [3] of both rays to the ground in the middle of the ``overlap``."""
    col, row = overlap.mean(axis=1)
    there = right.project(*left.localize(col, row, height), height)
    return ray_upwards(left, col, row, height), ray_upwards(right, *map(float, there), height)


def convergence_angle(
    left: SensorModel, right: SensorModel, overlap: Floats, height: float, names: tuple[str, str]
) -> float:
    """Angle in degrees between both rays in the middle of the overlap."""
    rays = middle_rays(left, right, overlap, height)
    angle = float(np.degrees(np.arccos(np.clip(rays[0] @ rays[1], -1.0, 1.0))))
    if not angle >= MIN_CONVERGENCE:
        raise InputError(
            f"left and right image see the ground from one direction (convergence {angle:.2f} "
            f"degrees; other image: {names[1]})",
            file=names[0],
            remedy="check that the two images are not the same view, and that each RPC belongs "
            "to its image",
        )
    return angle


def find_rotation(
    left: SensorModel, right: SensorModel, overlap: Floats, height: float
) -> tuple[Floats, float]:
    """Rotation float64[2, 3] of the left image to (x, y), and its angle in degrees.

    +x is the way that a point on a right ray goes in the left image when it rises: x_right stays,
    x_left and with it the disparity grow.
    """
    ground = left.localize(*overlap, height)
    there = right.project(*ground, height)
    ends = [left.project(*right.localize(*there, h), h) for h in (height - 50.0, height + 50.0)]
    way = np.array(ends[1]) - np.array(ends[0])
    east, south = np.nanmean(way / np.hypot(*way), axis=1)
    angle = round(float(np.degrees(np.arctan2(south, east))), 6)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, s, 0.0], [-s, c, 0.0]]), angle


def view_order(left: SensorModel, right: SensorModel, overlap: Floats, height: float) -> str:
    """Which image looks backward, if image rows run in flight direction."""
    col, row = overlap.mean(axis=1)
    base = np.subtract(*middle_rays(left, right, overlap, height))[:2]
    lon, lat = left.localize([col, col], [row - 50.0, row + 50.0], height)
    flight = np.array([(lon[1] - lon[0]) * np.cos(np.radians(lat[0])), lat[1] - lat[0]])
    length = float(np.linalg.norm(base))
    along = float(base @ flight / np.linalg.norm(flight)) / max(length, LEAST_BASE)
    if abs(along) < ALONG_TRACK:
        return "across track"
    return "left looks backward" if along > 0 else "left looks forward"


@dataclass(frozen=True, eq=False)
class GroundOfImages:
    """The ground that images show by their RPCs as they were delivered.

    Sensor models of images, one at least, and their ``sizes`` (cols, rows) px.

    No control point has a say in it, so that what is made for the ground of a site stays as it is
    when one is edited.
    """

    sensors: Sequence[SensorModel]
    sizes: Sequence[tuple[int, int]]

    @classmethod
    def open(cls, images: Sequence[str | Path]) -> GroundOfImages:
        """Of image files with RPCs. Raises InputError if one cannot be read."""
        from rasterio.errors import RasterioError  # of the files alone, as what reads them

        from ..core.products.rasters import open_raster
        from .rpc_files import read_rpc

        sensors, sizes = [], []
        for image in map(Path, images):
            sensors.append(SensorModel(read_rpc(image)))
            try:
                with open_raster(image) as dataset:
                    sizes.append((dataset.width, dataset.height))
            except RasterioError as error:
                raise InputError(
                    f"cannot be opened as an image ({error})", file=image, remedy="check the file"
                ) from None
        return cls(sensors, sizes)

    @property
    def pixel_deg(self) -> tuple[float, float]:
        """(lon, lat) size in degrees of a square on the ground, of the area of a pixel in the
        middle of the finest image.

        Raises InputError if an RPC reaches no ground there.
        """
        pixels = [
            pixel_deg(sensor, cols / 2, rows / 2, float(sensor.rpc.height_off))
            for sensor, (cols, rows) in zip(self.sensors, self.sizes)
        ]
        return min(pixels, key=lambda pixel: pixel[::-1])

    def shows(self, lon: Floats, lat: Floats, height: Floats) -> Bools:
        """Whether an image shows places [n] (degrees, degrees, m)."""
        return self._touched(lon[:, None], lat[:, None], height[:, None])

    def box(self, heights: tuple[float, float]) -> tuple[float, float, float, float]:
        """West, south, east, north (degrees) of what the images show between two heights, m."""
        places = []
        for sensor, (cols, rows) in zip(self.sensors, self.sizes):
            col, row = np.meshgrid([0.0, cols / 2, cols - 1.0], [0.0, rows / 2, rows - 1.0])
            places += [sensor.localize(col.ravel(), row.ravel(), height) for height in heights]
        lon, lat = np.concatenate(places, axis=1)
        ends = np.nanmin(lon), np.nanmin(lat), np.nanmax(lon), np.nanmax(lat)
        return tuple(map(float, ends))

    def may_show(self, boxes: Floats) -> Bools:
        """Whether an image may show something of boxes [n, 6] (west, south, lowest, east, north,
        highest; degrees, m)."""
        i, j, k = np.indices((2, 2, 2)).reshape(3, 8)
        return self._touched(boxes[:, 3 * i], boxes[:, 3 * j + 1], boxes[:, 3 * k + 2])

    def _touched(self, lon: Floats, lat: Floats, height: Floats) -> Bools:
        """Which boxes around corners [n, corners] touch the frame of an image."""
        out = np.zeros(len(lon), np.bool_)
        for sensor, (cols, rows) in zip(self.sensors, self.sizes):
            col, row = sensor.project(lon, lat, height)
            with np.errstate(invalid="ignore"):
                across = (col.max(axis=1) >= -SPARE_PX) & (col.min(axis=1) <= cols - 1 + SPARE_PX)
                along = (row.max(axis=1) >= -SPARE_PX) & (row.min(axis=1) <= rows - 1 + SPARE_PX)
            out |= across & along
        return out


def pixel_deg(sensor: SensorModel, col: float, row: float, height: float) -> tuple[float, float]:
    """(lon, lat) size in degrees of a square on level ground, of the area of a pixel.

    At an ellipsoidal ``height`` in m. Raises InputError if the RPC reaches no ground there.
    """
    lon, lat = sensor.localize([col, col + 1, col], [row, row, row + 1], height)
    if not np.isfinite(lon).all():
        raise InputError(
            "the RPC reaches no ground in the middle of the image",
            remedy="check that the RPC belongs to the image",
        )
    shrink = float(np.cos(np.radians(lat[0])))
    east, north = (lon[1:] - lon[0]) * shrink, lat[1:] - lat[0]
    side = float(np.sqrt(abs(east[0] * north[1] - east[1] * north[0])))
    return side / shrink, side
