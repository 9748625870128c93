"""Labels and time of CARS' ground_truth_reprojection beside this project's, on one synthetic pair.

CARS (CNES, Apache-2.0) projects a raster DSM. It gets all it can use: RPCs already corrected by
the same alignment, a DSM of the same LiDAR, and terrain. Needs `pip install cars` in an environment
of its own. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

import numpy as np
import rasterio
import yaml
import zarr
from rasterio.rpc import RPC as Tags
from rasterio.transform import from_origin
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import distance_transform_edt, map_coordinates, minimum_filter

from stereocities.__main__ import SEED, make_scene
from stereocities.cities import CITIES, CitySpec
from stereocities.surfaces import ROOF, WATER
from stereocities.truth import truth_at
from stereotruth.align.aligned_pair import Alignment
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.lidar.point_store import PointStore
from stereotruth.sensor.rpc import SensorModel

ROOT = Path(__file__).resolve().parents[1]
DSM_M = 0.5  # the peer's own choice for images of 0.65 m
TERRAIN_M = 30.0  # as SRTM
ROOF_M = 20.0  # m above the terrain: a high roof
Positions = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


# ------------------------------------------------------------------------------------- the pair


def small_city(name: str, size: int) -> CitySpec:
    """A city of one scene, ``size`` px square, at the middle of its first scene."""
    city = CITIES[name]
    scene = replace(
        city.scenes[0], cols=size, rows=size, lidar_grid=(1, 1), gap_m=(0, 0), ragged_m=(20, 20)
    )
    return replace(city, scenes=(scene,))


def timed(command: list[str], cwd: Path, log: Path, **environment: str) -> dict[str, float]:
    """Time and processor time of a command and all its processes."""
    begin, before = time.monotonic(), getrusage(RUSAGE_CHILDREN)
    with log.open("w") as stream:
        status = subprocess.call(
            command, cwd=cwd, stdout=stream, stderr=stream, env={**os.environ, **environment}
        )
    took = time.monotonic() - begin
    if status:
        sys.exit(f"{command[0]} ended with {status}: see {log}")
    after = getrusage(RUSAGE_CHILDREN)
    worked = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"time, s": took, "processor time, s": worked}


def make_ours(folder: Path, city: CitySpec, cores: int) -> dict[str, float]:
    """Make the disparity grid by the workflow, from images, LiDAR and GCPs; what it took."""
    scene = city.scenes[0].name
    row = {
        "scene": scene,
        "city": city.name,
        "left_image": "in/left.tif",
        "right_image": "in/right.tif",
        "lidar": "in/lidar",
        "lidar_crs": "",
        "geoid": "",
        "gcps": "in/gcps.csv",
    }
    (folder / "scenes.tsv").write_text("\t".join(row) + "\n" + "\t".join(row.values()) + "\n")
    columns = ["city", "prefix", "training", "validation", "testing"]
    (folder / "cities.tsv").write_text("\t".join(columns) + f"\n{city.name}\tXX\t0\t0\t1\n")
    sheets = {"scenes": "scenes.tsv", "cities": "cities.tsv"}
    (folder / "pair.yaml").write_text(yaml.safe_dump(sheets))
    for name in ("Snakefile", "workflow", "config", "profiles", "envs"):
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)
    return timed(
        [
            *(sys.executable, "-m", "snakemake", "--cores", str(cores), "--forceall"),
            *(f"results/project/{city.name}/{scene}.zarr", "--configfile", "pair.yaml"),
        ],
        folder,
        folder / "ours.log",
    )


# ------------------------------------------------------------------------------------ the peer


def write_view(path: Path, image: Path, sensor: SensorModel) -> None:
    """A copy of an image with the corrected RPC in its tags."""
    rpc, error = sensor.corrected_rpc()
    if error > 0.01:
        sys.exit(f"{image}: an RPC alone misses the aligned model by {error:.3f} px")
    values = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in rpc.to_dict().items()
    }
    with rasterio.open(image) as source:
        profile, pixels = source.profile, source.read()
    with rasterio.open(path, "w", **profile) as target:
        target.write(pixels)
        target.rpcs = Tags(**values, err_bias=0.0, err_rand=0.0)


def write_dsm(folder: Path, store: PointStore) -> tuple[Path, Path]:
    """Highest points in cells of DSM_M, gaps filled; and terrain in cells of TERRAIN_M."""
    west, south, east, north = store.bounds[:4]
    points = store.query(west, south, east, north)
    lat_step = DSM_M / 111_000
    lon_step = lat_step / np.cos(np.radians(south))
    shape = int((north - south) / lat_step) + 1, int((east - west) / lon_step) + 1
    row = ((north - points.lat) / lat_step).astype(np.int64)
    col = ((points.lon - west) / lon_step).astype(np.int64)
    dsm = np.full(shape, -np.inf, np.float32)
    np.maximum.at(dsm, (row, col), points.height.astype(np.float32))
    nearest = distance_transform_edt(np.isinf(dsm), return_distances=False, return_indices=True)
    dsm = dsm[tuple(nearest)]
    cells = int(TERRAIN_M / DSM_M)
    margin = 20  # cells of terrain around the LiDAR
    terrain = minimum_filter(dsm, cells)[cells // 2 :: cells, cells // 2 :: cells]
    terrain = np.pad(terrain, margin, mode="edge")
    paths = folder / "dsm.tif", folder / "terrain.tif"
    for path, values, step, edge in ((paths[0], dsm, 1, 0), (paths[1], terrain, cells, margin)):
        size = step * lon_step, step * lat_step
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            dtype="float32",
            count=1,
            height=values.shape[0],
            width=values.shape[1],
            crs="EPSG:4326",
            nodata=-32768,
            transform=from_origin(west - edge * size[0], north + edge * size[1], *size),
        ) as target:
            target.write(values.astype(np.float32), 1)
    return paths


def make_cars(
    folder: Path, cars: Path, data: Path, store: PointStore, alignment: Alignment, cores: int
) -> dict[str, float]:
    """Run CARS, intermediate data under ``out`` of the folder; what it took."""
    folder.mkdir(exist_ok=True)
    for view in ("left", "right"):
        write_view(folder / f"{view}.tif", data / f"{view}.tif", getattr(alignment, view))
    dsm, terrain = write_dsm(folder, store)
    config = {
        "input": {
            "sensors": {
                view: {
                    "image": str(folder / f"{view}.tif"),
                    "geomodel": {"path": str(folder / f"{view}.tif")},
                }
                for view in ("left", "right")
            },
            "pairing": [["left", "right"]],
            "initial_elevation": {"dem": str(terrain), "geoid": None},  # heights are ellipsoidal
        },
        # no product: it ends where the last of the intermediate data below is made
        "output": {"directory": str(folder / "out"), "product_level": []},
        "orchestrator": {"mode": "multiprocessing", "nb_workers": cores},
        "pipeline": {"subsampling": False, "surface_modeling": True},
        "surface_modeling": {
            "advanced": {"all": {"ground_truth_dsm": {"dsm": str(dsm)}}},
            "applications": {
                "all": {
                    "grid_generation": {"save_intermediate_data": True},
                    "ground_truth_reprojection": {
                        "method": "direct_loc",
                        "target": "epipolar",
                        "save_intermediate_data": True,
                    },
                }
            },
        },
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return timed(
        [str(cars), str(folder / "config.yaml")],
        folder,
        folder / "cars.log",
        PATH=f"{cars.parent}:{os.environ['PATH']}",
        PYTHONPATH="",
    )


class CarsGrids:
    """The epipolar geometry that CARS has resampled with, from its intermediate data.

    Files hold the (col, row) of nodes, with the upper-left pixel's centre at 0.5.
    """

    def __init__(self, folder: Path) -> None:
        self.left, self.right = (self._nodes(folder, view) for view in ("left", "right"))

    @staticmethod
    def _nodes(folder: Path, view: str) -> RegularGridInterpolator:
        with rasterio.open(folder / f"{view}_epi_grid.tif") as dataset:
            bands = dataset.read().astype(np.float64)
            across, x0, down, y0 = (dataset.transform[k] for k in (0, 2, 4, 5))
        rows, cols = (np.arange(n) for n in bands.shape[1:])
        nodes = y0 + down * (rows + 0.5), x0 + across * (cols + 0.5)
        values = np.moveaxis(bands, 0, -1) - 0.5
        return RegularGridInterpolator(nodes, values, bounds_error=False, fill_value=None)

    def to_left(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(col, row) in the left image of epipolar positions."""
        col, row = np.moveaxis(self.left(np.stack([y, x], axis=-1)), -1, 0)
        return col, row

    def from_right(self, col: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Epipolar (x, y) of positions in the right image, by steps of the mid-grid's affine."""
        middle = np.array([np.mean(axis) for axis in self.right.grid])
        step = 1.0
        at = [self.right(middle + d)[0] for d in ([0, 0], [step, 0], [0, step])]
        back = np.linalg.inv(np.stack([at[1] - at[0], at[2] - at[0]], axis=-1))
        wanted = np.stack([col, row], axis=-1)
        place = middle + (wanted - at[0]) @ back.T
        for _ in range(10):
            place = place + (wanted - self.right(place)) @ back.T
        return place[..., 1], place[..., 0]


def figures(
    labels: np.ndarray, city: CitySpec, to_left: Positions, from_right: Positions, terrain: Path
) -> dict[str, float]:
    """Errors of disparities x_left - x_right [y, x] (NaN: no label) against exact truth, px."""
    y, x = np.indices(labels.shape).astype(np.float64)
    truth = truth_at(city, city.scenes[0], *to_left(x, y))
    exact = x - from_right(truth["right_col"], truth["right_row"])[0]
    fair = (truth["covered"] > 0) & (truth["changed"] == 0) & (truth["changed_right"] == 0)
    fair &= truth["surface"] != WATER
    visible = fair & (truth["visible_right"] > 0)
    hidden = fair & (truth["hidden_right"] > 0)
    labelled = np.isfinite(labels)
    with rasterio.open(terrain) as dataset:
        inverse = ~dataset.transform
        row = (inverse.e * truth["lat"] + inverse.f) - 0.5
        col = (inverse.a * truth["lon"] + inverse.c) - 0.5
        ground = map_coordinates(dataset.read(1), np.nan_to_num([row, col]), order=1)
    roofs = (truth["surface"] == ROOF) & (truth["height"] - ground > ROOF_M)
    error = np.abs(labels - exact)
    use = visible & labelled
    return {
        "mean absolute error": float(error[use].mean()),
        "median": float(np.median(error[use])),
        f"on roofs above {ROOF_M:g} m": float(error[use & roofs].mean()),
        "over 1 px, %": 100 * float((error[use] > 1).mean()),
        "visible labelled, %": 100 * float(use.sum() / visible.sum()),
        "hidden labelled, %": 100 * float((hidden & labelled).sum() / hidden.sum()),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", type=Path, required=True, help="the command of its environment")
    parser.add_argument("--folder", type=Path, default=Path("results/cars"), help="made anew")
    parser.add_argument("--city", default="Qichun", choices=CITIES)
    parser.add_argument("--size", type=int, default=1200, help="px of the left image's sides")
    parser.add_argument("--cores", type=int, default=2)
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = given.folder.resolve()
    folder.mkdir(parents=True)
    city = small_city(given.city, given.size)
    scene = city.scenes[0].name
    make_scene(city, city.scenes[0], folder / "in", spacing_m=0.4, seed=SEED)
    rows = {"this project": make_ours(folder, city, given.cores)}
    made = folder / "results"
    store = PointStore(next((made / "ingest" / city.name / scene).glob("*.points")))
    alignment = Alignment.load(made / f"refine/{city.name}/{scene}/alignment.json")
    cars = given.cars.absolute()
    rows["CARS"] = make_cars(folder / "cars", cars, folder / "in", store, alignment, given.cores)

    terrain = folder / "cars/terrain.tif"
    model = EpipolarModel.load(made / f"rectify/{city.name}/{scene}/epipolar.json")
    grid = zarr.open_group(made / f"project/{city.name}/{scene}.zarr", mode="r")
    rows["this project"] |= figures(
        grid["disparity"][:], city, model.epipolar_to_left, model.right_to_epipolar, terrain
    )
    out = folder / "cars/out"
    grids = CarsGrids(next(out.rglob("left_epi_grid.tif")).parent)
    with rasterio.open(next(out.rglob("epipolar_disp_ground_truth_left.tif"))) as dataset:
        labels = -dataset.read(1)  # its disparities are x_right - x_left
    labels[labels == 0] = np.nan  # its nodata
    rows["CARS"] |= figures(labels, city, grids.to_left, grids.from_right, terrain)

    (folder / "figures.json").write_text(json.dumps(rows, indent=1))
    print(f"{'':28}" + "".join(f"{name:>16}" for name in rows))
    for key in rows["CARS"]:
        print(f"{key:28}" + "".join(f"{row[key]:16.3f}" for row in rows.values()))


if __name__ == "__main__":
    main()
