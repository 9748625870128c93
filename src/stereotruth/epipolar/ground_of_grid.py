"""Grids of a scene on the ground: where each pixel lies, in WGS 84."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyproj

from ..core.errors import InputError
from .model import EpipolarModel

if TYPE_CHECKING:
    import xarray as xr

SYSTEM = "EPSG:4979"  # WGS 84: longitude, latitude, ellipsoidal height


def with_ground(grid: xr.Dataset) -> xr.Dataset:
    """A grid, or a window of it, with the coordinates ``lon`` and ``lat`` [y, x] of its heights.

    ``grid``: of :func:`stereotruth.core.products.grids.open_grid`, with the array ``height`` (m
    over the ellipsoid) and the epipolar model in its attributes, as those of ``results/project``
    have them. Degrees, NaN where there is no height; the coordinate ``crs`` holds the system of all
    three by the CF conventions. All of the window is read: take a part of a large grid by
    ``isel`` or ``sel`` first. Raises InputError for a grid without heights or model.
    """
    for name, there in (("height", grid), ("epipolar", grid.attrs)):
        if name not in there:
            raise InputError(f"a grid without {name!r}", remedy="open a grid of results/project")
    model = EpipolarModel.from_dict(grid.attrs["epipolar"])
    height = grid["height"].values.astype(np.float64)
    x, y = np.meshgrid(grid["x"].values.astype(np.float64), grid["y"].values)
    if grid.attrs.get("view") == "right":
        x = x + grid["disparity"].values
    known = np.isfinite(height) & np.isfinite(x)
    lon, lat = np.full((2, *height.shape), np.nan)
    lon[known], lat[known] = model.epipolar_to_ground(x[known], y[known], height[known])
    names = {"lon": (lon, "longitude", "degrees_east"), "lat": (lat, "latitude", "degrees_north")}
    coordinates = {
        name: (("y", "x"), values, {"standard_name": of, "units": units, "grid_mapping": "crs"})
        for name, (values, of, units) in names.items()
    }
    found = grid.assign_coords(coordinates | {"crs": ((), 0, pyproj.CRS(SYSTEM).to_cf())})
    found["height"] = found["height"].assign_attrs(grid_mapping="crs")
    return found
