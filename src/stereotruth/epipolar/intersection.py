"""From epipolar pixels to the ground: where two rays meet, where the heights of a grid lie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.kernels import inner, kernel
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import DEGREE_M, turn
from ..sensor.rpc import project_point
from .model import EpipolarModel, inverse_point

if TYPE_CHECKING:
    import xarray as xr


SYSTEM = "EPSG:4979"  # WGS 84: longitude, latitude, ellipsoidal height
TOLERANCE_M = 1e-5
FRESH = 64  # px along a row after which the derivatives are taken anew
DEG = 1.0 / DEGREE_M  # per metre, about
GEOZARR = [  # conventions of Zarr, by which GDAL and rioxarray find system and place of a grid
    {
        "uuid": "f17cb550-5864-4468-aeb7-f3180cfb622f",
        "name": "proj:",
        "spec_url": "https://github.com/zarr-conventions/geo-proj/blob/v1/README.md",
    },
    {
        "uuid": "689b58e2-cf7b-45e0-9fff-9cfc0883d6b4",
        "name": "spatial:",
        "spec_url": "https://github.com/zarr-conventions/spatial/blob/v1/README.md",
    },
]
PLACE = (  # attributes of a grid
    *("zarr_conventions", "proj:code", "place"),
    *("spatial:dimensions", "spatial:transform", "spatial:bbox"),
)
PLACES = 9  # along each side of a grid, that its place on a map is taken from


@inner
def _project_both(sensors: Floats, lon: float, lat: float, h: float, out: Floats) -> None:
    out[0], out[1] = project_point(sensors[0], lon, lat, h)
    out[2], out[3] = project_point(sensors[1], lon, lat, h)


@inner
def _solver(sensors: Floats, lon: float, lat: float, h: float, out: Floats) -> None:
    """Fill ``out`` [3, 4]: (d lon, d lat, d h) by which 4 image residuals (px) are taken out."""
    ahead, behind, jacobian = np.empty(4), np.empty(4), np.empty((4, 3))
    for k in range(3):
        a, b, c = (DEG if k == 0 else 0.0), (DEG if k == 1 else 0.0), (1.0 if k == 2 else 0.0)
        _project_both(sensors, lon + a, lat + b, h + c, ahead)
        _project_both(sensors, lon - a, lat - b, h - c, behind)
        for i in range(4):
            jacobian[i, k] = (ahead[i] - behind[i]) / 2.0  # px per metre
    inverse = np.linalg.inv(jacobian.T @ jacobian) @ jacobian.T
    out[0] = inverse[0] * DEG
    out[1] = inverse[1] * DEG
    out[2] = inverse[2]


@inner
def _refine(
    sensors: Floats, solver: Floats, image: Floats, ground: Floats, steps: int, there: Floats
) -> bool:
    """Move ``ground`` [lon, lat, h] to where both rays meet; whether it came to rest."""
    for _ in range(steps):
        _project_both(sensors, ground[0], ground[1], ground[2], there)
        largest = 0.0
        for k in range(3):
            step = 0.0
            for i in range(4):
                step += solver[k, i] * (image[i] - there[i])
            ground[k] += step
            largest = max(largest, abs(step) / (DEG if k < 2 else 1.0))
        if largest < TOLERANCE_M:
            return True
        if not largest < 1e6:
            return False
    return False


@kernel
def _intersect(
    sensors: Floats, left: Floats, right: Floats, row0: int, col0: int,
    disparity: NDArray[np.float32], start: Floats, out: Floats,
) -> None:  # fmt: skip
    """Fill ``out`` [3, h, w] with lon, lat, h of a window of disparities, NaN where there is none.

    ``left`` and ``right`` are packed image models. A pixel starts where its neighbour ended: the
    derivatives change so little that two or three steps do.
    """
    solver, image, there = np.empty((3, 4)), np.empty(4), np.empty(4)
    ground, of_row = start.copy(), start.copy()
    for i in range(disparity.shape[0]):
        ground[:] = of_row
        since = FRESH
        first = True
        for j in range(disparity.shape[1]):
            d = disparity[i, j]
            x, y = float(col0 + j), float(row0 + i)
            if np.isfinite(d):
                image[0], image[1] = inverse_point(left, x, y)
                image[2], image[3] = inverse_point(right, x - d, y)
            if not (np.isfinite(d) and np.isfinite(image[0]) and np.isfinite(image[2])):
                out[:, i, j] = np.nan
                continue
            if since >= FRESH:
                _solver(sensors, ground[0], ground[1], ground[2], solver)
                since = 0
            good = _refine(sensors, solver, image, ground, 8, there)
            tries = 0
            while not good and tries < 10:  # far from the last one: derivatives of the place itself
                ground[:] = start if tries == 0 else ground
                _solver(sensors, ground[0], ground[1], ground[2], solver)
                good = _refine(sensors, solver, image, ground, 4, there)
                tries += 1
            if good:
                out[0, i, j], out[1, i, j], out[2, i, j] = ground[0], ground[1], ground[2]
                since += 1
                if first:
                    of_row[:] = ground
                    first = False
            else:
                out[:, i, j] = np.nan
                ground[:] = start
                since = FRESH


def intersect(
    model: EpipolarModel, disparity: NDArray[np.float32], row: int = 0, col: int = 0
) -> Floats:
    """float64[3, h, w]: longitude, latitude (degrees) and ellipsoidal height (m) of left pixels.

    ``disparity`` float32[h, w] px of the window of the epipolar grid whose first pixel is (row,
    col). NaN where it is NaN, and where the rays do not meet.
    """
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    centre = col + disparity.shape[1] / 2, row + disparity.shape[0] / 2
    lon, lat = model.epipolar_to_ground(*centre, model.reference_height)
    start = np.array([float(lon), float(lat), model.reference_height])
    out = np.empty((3, *disparity.shape))
    packed = model.sensors, model.left_image.packed, model.right_image.packed
    _intersect(*packed, row, col, disparity, start, out)
    return out


def with_ground(grid: xr.Dataset) -> xr.Dataset:
    """A grid, or a window of it, with the coordinates ``lon`` and ``lat`` [y, x] of its heights.

    ``grid``: of :func:`stereotruth.core.products.grids.open_grid`, with the array ``height`` (m
    over the ellipsoid) and the epipolar model in its attributes, as ``results/project`` has them.
    Degrees, NaN where there is no height; the coordinate ``crs`` holds the system of all three by
    the CF conventions. All of the window is read: take a part of a large grid by ``isel`` or
    ``sel`` first. Raises InputError for a grid without heights or model.
    """
    import pyproj  # which few callers of this module need

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


def utm_epsg(lon: float, lat: float) -> int:
    """EPSG code of the zone of UTM on WGS 84 in which a place lies, degrees."""
    return (32600 if lat >= 0 else 32700) + int((float(turn(lon)) + 180.0) // 6.0) + 1


def coarse_place(model: EpipolarModel, view: str = "left") -> dict[str, Any]:
    """Attributes of GeoZarr by which maps show the grid of a view, which lies on no map's plane.

    The place is the affine function of the pixels that comes nearest to what they see at the
    model's reference height, in metres of UTM: in degrees its terms are so small that rioxarray
    takes them for none. ``place`` says how far off it is there and over all heights of the model.
    Exact places are those of :func:`with_ground`.
    """
    import pyproj

    rows, cols = model.shape
    axes = np.linspace(0.0, cols - 1.0, PLACES), np.linspace(0.0, rows - 1.0, PLACES)
    x, y = (grid.ravel() for grid in np.meshgrid(*axes))
    seen = getattr(model, f"{view}_image").inverse(x, y)
    heights = model.reference_height, *model.height_range
    ground = np.stack([getattr(model, view).localize(*seen, height) for height in heights])
    known = np.isfinite(ground).all(axis=(0, 1))
    if known.sum() < 3:
        return {}
    design = np.column_stack([x + 0.5, y + 0.5, np.ones(x.size)])[known]  # from the grid's corner
    ground = ground[:, :, known]
    code = f"EPSG:{utm_epsg(*ground[0].mean(axis=1))}"
    to_map = pyproj.Transformer.from_crs("EPSG:4326", code, always_xy=True)
    ground = np.stack([to_map.transform(*places) for places in ground])
    fit = np.linalg.lstsq(design, ground[0].T)[0]
    off = np.linalg.norm(ground - (design @ fit).T, axis=1).max(axis=1)
    corners = np.array([[0, 0, 1], [cols, 0, 1], [0, rows, 1], [cols, rows, 1]]) @ fit
    return {
        "zarr_conventions": GEOZARR,
        "proj:code": code,
        "spatial:dimensions": ["y", "x"],
        "spatial:transform": fit.T.ravel().tolist(),
        "spatial:bbox": [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()],
        "place": f"coarse, to find the grid on a map: within {off[0]:.1f} m at {heights[0]:.0f} m "
        f"above the ellipsoid, {off.max():.0f} m from {heights[1]:.0f} to {heights[2]:.0f} m",
    }
