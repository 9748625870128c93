"""A built city in a file, so that jobs which look at the same one need not build it each.

Its top surface at any place is what a surface model should hold; the tests and benchmarks of
surface models are held against it.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from stereotruth.core.kernels import kernel
from stereotruth.core.products.files import atomic_file

from .cities import CitySpec
from .layout import frame_of
from .surfaces import IN_IMAGES, Surfaces, cast


def write_surfaces(city: CitySpec, out_npz: str | Path) -> None:
    """Build a city and write its surfaces: one array per field of :class:`.surfaces.Surfaces`."""
    built = surfaces_of(city)
    with atomic_file(out_npz) as scratch, scratch.open("wb") as stream:
        np.savez(stream, **built._asdict())


def surfaces_of(city: CitySpec, built: str | Path | None = None) -> Surfaces:
    """Everything that stands in a city, ready for casting rays.

    ``built``: a file of :func:`write_surfaces`, which is read in a hundredth of the seconds that
    building takes; None builds the city. Kept for further calls of the same process.
    """
    return _surfaces_of(city, None if built is None else Path(built))


@lru_cache(maxsize=2)
def _surfaces_of(city: CitySpec, built: Path | None) -> Surfaces:
    if built is None:
        from .world import build_surfaces  # its imports take longer than reading the file

        return build_surfaces(city)
    with np.load(built) as fields:
        return Surfaces(**{
            name: fields[name] if fields[name].ndim else fields[name].item() for name in fields
        })  # fmt: skip


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
