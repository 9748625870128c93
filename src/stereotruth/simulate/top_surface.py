"""The top surface of a synthetic city at any place, exactly: what a surface model should hold.

No rule makes it: the tests and benchmarks of surface models are held against it.
"""

from __future__ import annotations

import numpy as np

from ..kernels import kernel
from .built_city import surfaces_of
from .cities import CitySpec
from .layout import frame_of
from .surfaces import IN_IMAGES, cast

PASSES = 2  # up is the ellipsoid's normal at the city's centre: the place follows from the height


@kernel
def _tops(s, xy, view, z, kind):
    for n in range(xy.shape[0]):
        z[n], kind[n], _, _, _, _, _ = cast(
            s, s.lidar_top, xy[n, 0], xy[n, 1], 0.0, 0.0, view, True, 0.0
        )


def top_surface(
    city: CitySpec, lon: np.ndarray, lat: np.ndarray, view: int = IN_IMAGES
) -> tuple[np.ndarray, np.ndarray]:
    """Ellipsoidal height (m) and kind of the top surface at longitudes and latitudes, degrees.

    Of any one shape. ``view``: the world that the images see, or that of the LiDAR (IN_LIDAR).
    Kinds are those of :mod:`.surfaces`; outside the city NONE, and heights NaN.
    """
    surfaces, frame = surfaces_of(city), frame_of(city)
    lon, lat = (np.asarray(v, dtype=np.float64) for v in (lon, lat))
    at = [lon.ravel(), lat.ravel()]
    height = np.full(lon.size, city.base_height_m)
    z, kind = np.empty(lon.size), np.empty(lon.size, np.uint8)
    for _ in range(PASSES):
        xyz = frame.from_geodetic(np.column_stack([*at, height]))
        _tops(surfaces, np.ascontiguousarray(xyz[:, :2]), view, z, kind)
        xyz[:, 2] = z
        height = frame.to_geodetic(xyz)[:, 2]
    height[kind == 0] = np.nan
    return height.reshape(lon.shape), kind.reshape(lon.shape)
