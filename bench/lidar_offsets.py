"""LiDAR that does not lie where images do: strips that disagree, and national frames.

``strips``: cities are drawn, flown in four strips that are off by centimetres in height and
decimetres in plan, labelled as they are (``named``) and with the points moved (``adjusted``), and
compared with their exact truth. ``frames``: one small synthetic scene for each country goes through
the whole workflow twice: with its LiDAR in WGS 84, which is taken as ITRF at the date of the
images, and with the same points in the national frame, where PROJ's time-dependent operations
(written out from EPSG's parameters) put them at that date. Both must make the same place and height
of a point, and of a pixel of the original image. See README.md beside this file.

python bench/lidar_offsets.py strips --cities 2 3
python bench/lidar_offsets.py frames Usa France
"""

from __future__ import annotations

import argparse
import csv
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import laspy
import numpy as np
import pyproj
import yaml
import zarr
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from synthetic_pairs import SEED, VIEWS, fly, label_by

from stereocities.cities import CitySpec, FlightStrip, Jitter, SceneSpec, ViewSpec, training_city
from stereocities.control_points import simulate_points
from stereocities.render import simulate_image
from stereocities.sites import make_scene
from stereotruth.align.align import align
from stereotruth.align.refine import refine
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.numerics.geometry import metres_per_degree
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.epipolar_truth import write_grid_truth
from stereotruth.lidar.frames import Epoch, Epochs
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.strip_comparison import compare_strips
from stereotruth.lidar.strips import move_strips
from stereotruth.lidar.to_wgs84 import to_wgs84
from stereotruth.project.simulated_project import DEMO

OFFSETS_M = (0.31, 0.0, 0.07), (-0.2, 0.25, -0.06), (0.1, -0.33, 0.09), (-0.25, -0.15, -0.08)
DENSITIES = 10.6, 2.6, 5.0, 4.0  # points/m²
EDGE_PX = 4  # from edges of truth: ground beyond is judged
GROUND = 1

# Frames.
Floats = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
LIDAR = ("in/lidar", "national")  # in WGS 84, in the frame
DEMO_SEED, SPACING_M, SIDE_PX, TILE_PX = 1, 0.5, 560, 128
NAD83 = (
    "+proj=helmert +x=1.0039 +y=-1.90961 +z=-0.54117 +rx=0.02678138 +ry=-0.00042027 "
    "+rz=0.01093206 +s=-5.109e-05 +dx=0.00079 +dy=-0.0007 +dz=-0.00124 +drx=6.667e-05 "
    "+dry=-0.00075744 +drz=-5.133e-05 +ds=-7.201e-05 +t_epoch=2010 +convention=coordinate_frame"
)
GDA2020 = (
    "+inv +proj=helmert +x=0.0014 +y=0.0009 +z=-0.0014 +s=0.00042 +dy=0.0001 +dz=-0.0002 "
    "+t_epoch=2015 +convention=position_vector +step +proj=helmert +drx=0.00150379 "
    "+dry=0.00118346 +drz=0.00120716 +t_epoch=2020 +convention=coordinate_frame"
)
ETRS89 = (
    "+proj=helmert +rx=0.002236 +ry=0.013494 +rz=-0.019578 +drx=8.6e-05 +dry=0.000519 "
    "+drz=-0.000753 +t_epoch=2015 +convention=position_vector"
)
NZGD2000 = (  # the plate's motion back to 2000.0, then ITRF96 at that epoch
    "+inv +proj=helmert +drx=0.001487 +dry=0.001175 +drz=0.001223 +t_epoch=2000 "
    "+convention=position_vector +step +inv +proj=helmert +x=-0.005 +y=-0.0051 +z=0.0314 "
    "+rz=-0.00006 +s=-0.00218 +convention=position_vector"
)


def drawn_strips(number: int, side_px: int, jitter_px: float) -> CitySpec:
    """A city of one scene, flown in strips, whose images may jitter."""
    city = training_city(number, SEED, side_px)
    scene = replace(city.scenes[0], name="Strips", lidar_grid=(1, 2))
    strips = tuple(FlightStrip(o, d**-0.5) for o, d in zip(OFFSETS_M, DENSITIES))
    view = ViewSpec(jitter=Jitter(jitter_px)) if jitter_px else ViewSpec()
    return replace(city, name="Strips", scenes=(scene,), strips=strips, left=view, right=view)


def make_strips(city: CitySpec, folder: Path) -> tuple[list[Path], list[Path]]:
    """Images and point stores of a city, and its control points, in a folder."""
    scene = city.scenes[0]
    images = [folder / f"{view}.tif" for view in VIEWS]
    for view, image in zip(VIEWS, images):
        simulate_image(city, scene, view, image, seed=SEED)
    tables = (folder / f"{name}.csv" for name in ("gcps", "gcps_exact", "checkpoints"))
    simulate_points(city, scene, *tables, seed=SEED)
    (folder / "named").mkdir(exist_ok=True)
    stores = fly(city, scene, folder / "named", SEED)
    return images, stores


def judge(folder: Path) -> dict[str, float]:
    """Errors (px) of the labels of ground beyond EDGE_PX of edges, and shares within 1 and 2 σ."""
    made, truth = zarr.open(folder / "disparity.zarr"), zarr.open(folder / "truth.zarr")
    error = made["disparity"][:] - truth["disparity"][:]
    sigma = made["uncertainty"][:]
    use = (truth["visible"][:] == 1) & (truth["changed"][:] == 0) & np.isfinite(error)
    use &= truth["surface"][:] == GROUND
    use &= ~binary_dilation(truth["edge"][:] > 0, iterations=EDGE_PX)
    error, sigma = error[use], sigma[use]
    return {
        "labels": error.size,
        "mean": float(error.mean()),
        "rms": float(np.sqrt((error**2).mean())),
        "sigma": float(np.median(sigma)),
        **{f"within_{k}_sigma": float((np.abs(error) < k * sigma).mean()) for k in (1, 2)},
    }


def strips(given: argparse.Namespace) -> None:
    """offsets that are found, and labels against truth"""
    for number in given.cities:
        city = drawn_strips(number, given.side, given.jitter)
        folder = given.folder / f"{number}-{given.side}-{given.jitter:g}"
        folder.mkdir(parents=True, exist_ok=True)
        images, stores = make_strips(city, folder)
        found = compare_strips([PointStore(store) for store in stores])
        of = {int(strip.name) - 1: np.array(strip.offset_m) for strip in found.strips}
        reference = int(found.strips[0].name) - 1
        for k, offset in sorted(of.items()):
            miss = offset - np.subtract(OFFSETS_M[k], OFFSETS_M[reference])
            plan, up = 100 * np.hypot(*miss[:2]), 100 * miss[2]
            print(f"city {number}, strip {k + 1}: {plan:.1f} cm in plan, {up:+.1f} cm in height")
        moved = [folder / "adjusted" / store.name for store in stores]
        for store, out in zip(stores, moved):
            move_strips(store, found, out)
        for name, points in (("named", stores), ("adjusted", moved)):
            out = folder / f"labels_{name}"
            out.mkdir(exist_ok=True)
            alone = align(*images, folder / "gcps.csv", provenance={})
            alignment, _ = refine(alone, *images, points, provenance={})
            label_by(alignment, images, points, out, LabelSettings(), workers=given.threads)
            truth = out / "epipolar.json", out / "truth.zarr"
            write_grid_truth(city, city.scenes[0], *truth, workers=given.threads)
            print(f"city {number}, {name}:", {k: round(v, 4) for k, v in judge(out).items()})


# ------------------------------------------------------------------------------- frames


@dataclass(frozen=True)
class Country:
    """A place, the UTM zone of WGS 84 there, the national system of the LiDAR, the day of the
    images, and PROJ's steps from ITRF2020 to the national frame, geocentric."""

    lon: float
    lat: float
    utm: int
    system: int
    day: str
    year: float
    steps: str


COUNTRIES = {
    "Usa": Country(-122.30, 47.60, 32610, 6339, "2020-01-01", 2020.00137, NAD83),
    "Canada": Country(-79.40, 43.70, 32617, 2958, "2023-05-27", 2023.4014, NAD83),
    "Australia": Country(151.20, -33.90, 32756, 7856, "2026-01-01", 2026.00137, GDA2020),
    "France": Country(2.35, 48.85, 32631, 25831, "2020-01-01", 2020.00137, ETRS89),
    "NewZealand": Country(174.80, -36.90, 32760, 2193, "2021-07-02", 2021.5, NZGD2000),
}


def to_national(file: Path, to: Path, country: Country) -> None:
    """The points of a LAS file in UTM of WGS 84 (ITRF2020) in the national system."""
    las = laspy.read(file)
    lon, lat, height = pyproj.Transformer.from_crs(
        pyproj.CRS.from_epsg(country.utm).to_3d(), "EPSG:4979", always_xy=True
    ).transform(np.array(las.x), np.array(las.y), np.array(las.z))
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        f"+ellps=GRS80 +step {country.steps} +step +inv +proj=cart +ellps=GRS80 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    moved = pyproj.Transformer.from_pipeline(pipeline).transform(
        lon, lat, height, np.full(len(lon), country.year)
    )
    system = pyproj.CRS.from_epsg(country.system)
    x, y = pyproj.Transformer.from_crs(
        system.geodetic_crs.to_2d(), system, always_xy=True
    ).transform(moved[0], moved[1])
    header = laspy.LasHeader(version="1.4", point_format=las.header.point_format.id)
    header.offsets, header.scales = np.floor([x.min(), y.min(), 0.0]), np.full(3, 0.001)
    header.add_crs(system.to_3d())
    out = laspy.LasData(header)
    for name in las.point_format.dimension_names:
        if name not in ("X", "Y", "Z"):
            out[name] = las[name]
    out.x, out.y, out.z = x, y, moved[2]
    out.write(to)


def made_project(name: str, folder: Path) -> Path:
    """A project of two cities, the same scene with its LiDAR in WGS 84 and in the frame."""
    country, project = COUNTRIES[name], folder / name
    if (project / "config.yaml").is_file():
        return project
    spec = SceneSpec(
        f"{name}-1", (0.0, 0.0), SIDE_PX, SIDE_PX, 5, lidar_grid=(1, 1), ragged_m=(20.0, 20.0)
    )
    city = replace(DEMO, name=name, lon=country.lon, lat=country.lat, epsg=country.utm,
                   scenes=(spec,))  # fmt: skip
    make_scene(city, spec, project / "in", spacing_m=SPACING_M, seed=DEMO_SEED)
    (project / "national").mkdir()
    for file in sorted((project / "in" / "lidar").iterdir()):
        to_national(file, project / "national" / file.name, country)
    tables = {
        "cities": [["city", "prefix", "training", "validation", "testing"]],
        "images": [["image", "city", "file", "acquired"]],
        "scenes": [["scene", "city", "left_image", "right_image", "lidar", "lidar_crs", "geoid",
                    "gcps"]],
    }  # fmt: skip
    for k, lidar in enumerate(LIDAR):
        town = f"{name}{k}"
        tables["cities"].append([town, f"T{k}", "6", "1", "3"])
        for view in ("left", "right"):  # a copy for each city: the sheet has a file once
            shutil.copy(project / f"in/{view}.tif", project / f"in/{view}{k}.tif")
            tables["images"].append([f"{view}{k}", town, f"in/{view}{k}.tif", country.day])
        images = [f"left{k}", f"right{k}"]
        tables["scenes"].append([f"{town}-1", town, *images, lidar, "", "", "in/gcps.csv"])
    for table, rows in tables.items():
        with (project / f"{table}.tsv").open("w", newline="") as stream:
            csv.writer(stream, delimiter="\t", lineterminator="\n").writerows(rows)
    config = {key: f"{key}.tsv" for key in tables}
    config["tiles"] = {"size": TILE_PX, "min_labelled": 0.3}
    (project / "config.yaml").write_text(yaml.safe_dump(config))
    return project


def metres(lon: Floats, lat: Floats, height: Floats, judge: Sequence[Floats]) -> Floats:
    """Median east, north, up of places less those of the judge."""
    per = metres_per_degree(float(np.median(lat)))
    east, north = (lon - judge[0]) * per[0], (lat - judge[1]) * per[1]
    return np.nanmedian(np.stack([east, north, height - judge[2]]), axis=1)


def points(project: Path, country: Country) -> Floats:
    """How far the points are off as ingest takes them, east, north, up (m)."""
    epochs = Epochs(Epoch(country.year, "the sheet"))
    placed = []
    for folder in LIDAR:
        (file,) = sorted((project / folder).iterdir())
        las = laspy.read(file)
        transform = to_wgs84(las.header, file, epochs=epochs)
        placed.append(transform(np.array(las.x), np.array(las.y), np.array(las.z)))
    return metres(*placed[1], placed[0])


def pixels(project: Path, name: str) -> tuple[Floats, float, int]:
    """How far places and heights of the left image's pixels are off, east, north, up (m), labels
    by disparity (px), and how many there are."""
    heights, disparities, models = [], [], []
    for k in (0, 1):
        store = zarr.open_group(project / f"results/project/{name}{k}/{name}{k}-1.zarr", mode="r")
        models.append(EpipolarModel.from_dict(store.attrs["epipolar"]))
        disparities.append(store["disparity"][:].astype(np.float64))
        heights.append(np.where(np.isfinite(disparities[k]), store["height"][:], np.nan))
    row, col = np.nonzero(np.isfinite(heights[0]))
    x, y = col.astype(float), row.astype(float)
    there = models[1].left_to_epipolar(*models[0].epipolar_to_left(x, y))
    at = tuple(np.rint(v).astype(int) for v in reversed(there))
    inside = np.all([(v >= 0) & (v < n) for v, n in zip(at, heights[1].shape)], axis=0)
    x, y, row, col, *at = (v[inside] for v in (x, y, row, col, *at))
    there = [v[inside] for v in there]
    judge = (*models[0].epipolar_to_ground(x, y, heights[0][row, col]), heights[0][row, col])
    height = heights[1][tuple(at)]
    known = np.isfinite(height)
    found = models[1].epipolar_to_ground(*(v[known] for v in there), height[known])
    off = metres(*found, height[known], [v[known] for v in judge])
    change = disparities[1][tuple(at)] - disparities[0][row, col]
    return off, float(np.nanmedian(change)), int(known.sum())


def frames(given: argparse.Namespace) -> None:
    """places and heights by a national frame less those by WGS 84"""
    for name in given.countries or COUNTRIES:
        project = made_project(name, given.folder)
        stores = [f"results/project/{name}{k}/{name}{k}-1.zarr" for k in (0, 1)]
        command = [sys.executable, "-m", "snakemake", "--cores", "1", "--quiet", "all"]
        command += ["--snakefile", ROOT / "Snakefile", "--directory", project]
        command += ["--configfile", project / "config.yaml", "--", *stores]
        subprocess.run(command, check=True)
        off, change, count = pixels(project, name)
        of_points = points(project, COUNTRIES[name])
        for what, shift in (("points", of_points), ("pixels", off)):
            east, north, up = shift
            print(f"{name}: {what} east {east:+.4f}, north {north:+.4f}, up {up:+.4f} m")
        print(f"{name}: disparity {change:+.4f} px at {count} pixels", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = parser.add_subparsers(required=True)
    of_strips = parts.add_parser("strips", help=strips.__doc__)
    of_strips.set_defaults(run=strips)
    of_strips.add_argument("--folder", type=Path, default=Path("results/strips_bench"))
    of_strips.add_argument("--cities", type=int, nargs="+", default=[2, 3], help="by number")
    of_strips.add_argument("--side", type=int, default=800, help="px of the left image")
    of_strips.add_argument("--jitter", type=float, default=0.0, help="px rms of both attitudes")
    of_strips.add_argument("--threads", type=int, default=2)
    of_frames = parts.add_parser("frames", help=frames.__doc__)
    of_frames.set_defaults(run=frames)
    of_frames.add_argument("countries", nargs="*", help=", ".join(COUNTRIES))
    of_frames.add_argument("--folder", type=Path, default=Path("results/frames"))
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
