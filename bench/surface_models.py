"""Faults planted in an exact surface model, and what the scores of surface models say of each.

A synthetic city is flown by LiDAR, its surface is written as a GeoTIFF, exact at the centres of the
cells, and each fault is planted in a copy. See README.md beside this file.

python bench/surface_models.py --json faults.json
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter, maximum_filter, uniform_filter

from stereotruth.command.example_city import DEMO
from stereotruth.evaluation.surface_models.height_errors import OPEN, SOLID
from stereotruth.evaluation.surface_models.reference import LidarReference
from stereotruth.evaluation.surface_models.score import score_surface_model
from stereotruth.lidar.ingest import ingest
from stereotruth.simulate.built_city import top_surface
from stereotruth.simulate.cities import CITIES, CitySpec, lidar_files
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.surfaces import IN_LIDAR

Heights = NDArray[np.float64]
EVERY = {"Demo": DEMO, **CITIES}
CELL_M = 0.65
SIDE_M = 380.0
NODATA = -9999.0
SHIFT_M = (2.37, -1.41, 0.83)  # east, north, up
TILT = 0.002  # m per m, along east
UNDULATION = (-17.3, 3e-5)  # m in the middle, and per m along north: a geoid's


def surface(
    city: CitySpec, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[Heights, float, float]:
    """Heights (m) of a city's middle as the LiDAR meets it, moved; west, north of the grid."""
    scene = city.scenes[0]
    to_utm = pyproj.Transformer.from_crs(4326, city.epsg, always_xy=True)
    east, north = np.add(to_utm.transform(city.lon, city.lat), scene.centre_m)
    west, top, n = east - SIDE_M / 2, north + SIDE_M / 2, round(SIDE_M / CELL_M)
    row, col = np.mgrid[:n, :n]
    x, y = west + (col + 0.5) * CELL_M - shift[0], top - (row + 0.5) * CELL_M - shift[1]
    lon, lat = to_utm.transform(x, y, direction="INVERSE")
    return top_surface(city, lon, lat, IN_LIDAR)[0], west, top


def write(path: Path, heights: Heights, west: float, north: float, epsg: int) -> Path:
    """A GeoTIFF of heights."""
    values = np.where(np.isfinite(heights), heights, NODATA).astype(np.float32)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=values.shape[1],
        height=values.shape[0],
        count=1,
        dtype="float32",
        nodata=NODATA,
        crs=f"EPSG:{epsg}",
        transform=from_origin(west, north, CELL_M, CELL_M),
    ) as target:
        target.write(values, 1)
    return path


def noise(heights: Heights, rng: np.random.Generator) -> Heights:
    """0.3 m of noise, alike over some 2 m."""
    field = gaussian_filter(rng.standard_normal(heights.shape), 2.0 / CELL_M)
    return heights + 0.3 * field / field.std()


def spikes(heights: Heights, rng: np.random.Generator) -> Heights:
    """One cell in 200 off by 5 to 40 m, to either side."""
    size = rng.uniform(5, 40, heights.shape) * rng.choice([-1, 1], heights.shape)
    return np.where(rng.random(heights.shape) < 0.005, heights + size, heights)


def holes(heights: Heights, rng: np.random.Generator) -> Heights:
    """A tenth of the cells without a height, in patches of some 8 m."""
    field = gaussian_filter(rng.standard_normal(heights.shape), 4.0 / CELL_M)
    return np.where(field > np.quantile(field, 0.9), np.nan, heights)


def along(heights: Heights, axis: int) -> Heights:
    """Metres from the middle, eastward (1) or northward (0)."""
    row, col = np.mgrid[: heights.shape[0], : heights.shape[1]]
    at = col if axis else -row
    return (at - at.mean()) * CELL_M


def wider(heights: Heights) -> Heights:
    """Everything that stands up grown by a cell to each side, as matchers do it."""
    return maximum_filter(heights, 3)


FAULTS: dict[str, Callable[[Heights, np.random.Generator], Heights]] = {
    "as it is": lambda z, _: z,
    "blur, 1 m (standard deviation)": lambda z, _: gaussian_filter(z, 1.0 / CELL_M),
    "blur, box of 5 cells": lambda z, _: uniform_filter(z, 5),
    "roofs a cell too wide": lambda z, _: wider(z),
    "tilt, 2 m per km": lambda z, _: z + TILT * along(z, 1),
    "geoid left out": lambda z, _: z - UNDULATION[0] - UNDULATION[1] * along(z, 0),
    "noise, 0.3 m": noise,
    "spikes, 0.5 % of the cells": spikes,
    "holes, 10 % of the cells": holes,
}


def row_of(path: Path, reference: LidarReference) -> dict[str, Any]:
    """The figures of the table, and seconds of processor time."""
    begin = time.process_time()
    found = score_surface_model(path, reference).figures()
    moved, edges = found["registration"], found["edges"]
    names = ("east_m", "north_m", "up_m", "tilt_east_m_per_km", "tilt_north_m_per_km")
    return {
        **{name: moved[name] for name in names},
        **{f"sigma_{name}": moved[f"sigma_{name}"] for name in names},
        "off_steps_mae_m": found["errors"][OPEN]["mean_absolute_m"],
        "off_steps_over_3_m": found["errors"][OPEN]["share_over_3_m"],
        "all_mae_m": found["errors"][SOLID]["mean_absolute_m"],
        "all_mean_m": found["errors"][SOLID]["mean_m"],
        "nmad_m": found["errors"][SOLID]["nmad_m"],
        "known_share": found["errors"][SOLID]["known_share"],
        "edges": edges["edges"],
        "edge_error_m": edges["position_error_m"],
        "edge_outward_m": edges["outward_m"],
        "edge_missing_share": edges["missing_share"],
        "seconds": round(time.process_time() - begin, 1),
    }


def show(name: str, row: dict[str, Any]) -> None:
    """A line of the table in Markdown."""
    place = ", ".join(f"{row[n]:.3f} ± {row[f'sigma_{n}']:.3f}" for n in list(row)[:3])
    print(
        f"| {name} | {place} | {row['tilt_east_m_per_km']:.2f} | {100 * row['known_share']:.1f} | "
        f"{row['off_steps_mae_m']:.3f} | {100 * row['off_steps_over_3_m']:.2f} | "
        f"{row['all_mae_m']:.3f} | {row['edge_error_m']:.3f} | {row['edge_outward_m']:+.3f} |",
        flush=True,
    )


def main() -> None:
    """Print the table; ``--json`` keeps the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--city", choices=list(EVERY), default="Demo")
    parser.add_argument("--fault", action="append", choices=["shift", *FAULTS], help="default: all")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    city = EVERY[given.city]
    scene = city.scenes[0]
    table: dict[str, dict[str, Any]] = {}
    print(
        "| planted | east, north, up, m | tilt, m/km | known, % | off steps, m | over 3 m, % | "
        "all, m | edges, m | outward, m |\n|---" + "|---" * 8 + "|"
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        stores = []
        for name in lidar_files(city, scene):
            simulate_lidar_tile(city, scene, name, folder / name, seed=1)
            stores.append(folder / f"{name}.points")
            ingest(folder / name, stores[-1])
        reference = LidarReference(stores)
        exact, west, north = surface(city)
        for name in given.fault or ["as it is", "shift", *list(FAULTS)[1:]]:
            if name == "shift":
                heights = surface(city, SHIFT_M[:2])[0] + SHIFT_M[2]
                name = "shift by {:g}, {:g}, {:g} m".format(*SHIFT_M)
            else:
                heights = FAULTS[name](exact, np.random.default_rng(1))
            path = write(folder / "model.tif", heights, west, north, city.epsg)
            table[name] = row_of(path, reference)
            show(name, table[name])
    if given.json:
        given.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
