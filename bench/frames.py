"""Places and heights of scenes whose LiDAR is in a national frame and whose control points are ITRF.

One small synthetic scene for each country, through the whole workflow, twice: with its LiDAR in WGS 84, which is taken
as ITRF at the date of the images, and with the same points in the national frame, where PROJ's
time-dependent operations (written out from EPSG's parameters) put them at that date. What both make
of a pixel must be the same place and height.

python bench/frames.py FOLDER [COUNTRY …]
"""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import laspy
import numpy as np
import pyproj
import yaml
import zarr
from numpy.typing import NDArray

from stereotruth.command.example_city import DEMO
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.numerics.degrees import metres_per_degree
from stereotruth.simulate.__main__ import make_scene
from stereotruth.simulate.cities import SceneSpec

Floats = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
SEED, SPACING_M, SIDE_PX, TILE_PX = 1, 0.5, 560, 128
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
        CRS_3D(country.utm), "EPSG:4979", always_xy=True
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


def CRS_3D(code: int) -> pyproj.CRS:
    return pyproj.CRS.from_epsg(code).to_3d()


def made(name: str, folder: Path) -> Path:
    """A project of two cities, the same scene with its LiDAR in WGS 84 and in the frame."""
    country, project = COUNTRIES[name], folder / name
    if (project / "config.yaml").is_file():
        return project
    spec = SceneSpec(
        f"{name}-1", (0.0, 0.0), SIDE_PX, SIDE_PX, 5, lidar_grid=(1, 1), ragged_m=(20.0, 20.0)
    )
    city = replace(DEMO, name=name, lon=country.lon, lat=country.lat, epsg=country.utm,
                   scenes=(spec,))  # fmt: skip
    make_scene(city, spec, project / "in", spacing_m=SPACING_M, seed=SEED)
    (project / "national").mkdir()
    for file in sorted((project / "in" / "lidar").iterdir()):
        to_national(file, project / "national" / file.name, country)
    tables = {
        "cities": [["city", "prefix", "training", "validation", "testing"]],
        "images": [["image", "city", "file", "acquired"]],
        "scenes": [["scene", "city", "left_image", "right_image", "lidar", "lidar_crs", "geoid",
                    "gcps"]],
    }  # fmt: skip
    for k, lidar in enumerate(("in/lidar", "national")):
        town = f"{name}{k}"
        tables["cities"].append([town, f"T{k}", "6", "1", "3"])
        views = [f"in/{view}.tif" for view in ("left", "right")]
        copies = []
        for view in views:
            copy = Path(view).with_stem(f"{Path(view).stem}{k}")
            (project / copy).symlink_to(Path(view).name) if False else None
            copies.append(str(copy))
            (project / copy).write_bytes((project / view).read_bytes())
            tables["images"].append([f"{Path(copy).stem}", town, str(copy), country.day])
        stems = [Path(copy).stem for copy in copies]
        tables["scenes"].append([f"{town}-1", town, *stems, lidar, "", "", "in/gcps.csv"])
    for table, rows in tables.items():
        with (project / f"{table}.tsv").open("w", newline="") as stream:
            csv.writer(stream, delimiter="\t", lineterminator="\n").writerows(rows)
    config = {key: f"{key}.tsv" for key in tables} | {"tiles": {"size": TILE_PX, "min_labelled": 0.3}}  # fmt: skip
    (project / "config.yaml").write_text(yaml.safe_dump(config))
    return project


def places(project: Path, town: str) -> tuple[Floats, Floats, EpipolarModel]:
    """Heights of labels on the grid, rows and columns of which are those of the model."""
    store = zarr.open_group(project / f"results/project/{town}/{town}-1.zarr", mode="r")
    model = EpipolarModel.from_dict(store.attrs["epipolar"])
    height = np.where(np.isfinite(store["disparity"][:]), store["height"][:], np.nan)
    return height.astype(np.float64), store["disparity"][:].astype(np.float64), model


def compare(project: Path, name: str) -> None:
    """Print what the frame changes of places and heights."""
    (h0, d0, m0), (h1, d1, m1) = (places(project, f"{name}{k}") for k in (0, 1))
    print(f"{name}: grids {h0.shape} {h1.shape}, labels {np.isfinite(h0).sum()} {np.isfinite(h1).sum()}")  # fmt: skip
    rows, cols = np.nonzero(np.isfinite(h0))
    pick = np.random.default_rng(0).choice(rows.size, min(rows.size, 4000), replace=False)
    rows, cols = rows[pick], cols[pick]
    # The same pixel of the left original image, in both grids.
    lon, lat = m0.epipolar_to_ground(cols.astype(float), rows.astype(float), h0[rows, cols])
    col, row = m0.left.project(lon, lat, h0[rows, cols])
    x, y = m1.left_to_epipolar(col, row) if hasattr(m1, "left_to_epipolar") else (None, None)
    if x is None:
        x, y, _, _ = m1.ground_to_epipolar(lon, lat, h0[rows, cols])
    near = np.rint(y).astype(int), np.rint(x).astype(int)
    inside = (near[0] >= 0) & (near[1] >= 0) & (near[0] < h1.shape[0]) & (near[1] < h1.shape[1])
    near = near[0][inside], near[1][inside]
    other = h1[near]
    lon1, lat1 = m1.epipolar_to_ground(near[1].astype(float), near[0].astype(float), other)
    dh = other - h0[rows, cols][inside]
    per = metres_per_degree(float(np.mean(lat)))
    shift = np.nanmedian(np.stack([(lon1 - lon[inside]) * per[0], (lat1 - lat[inside]) * per[1], dh]), axis=1)  # fmt: skip
    dd = d1[near] - d0[rows, cols][inside]
    print(f"  east {shift[0]:+.4f} m, north {shift[1]:+.4f} m, up {shift[2]:+.4f} m (medians), "
          f"disparity {np.nanmedian(dd):+.4f} px")  # fmt: skip


def main() -> None:
    folder = Path(sys.argv[1])
    for name in sys.argv[2:] or COUNTRIES:
        project = made(name, folder)
        towns = [f"results/project/{name}{k}/{name}{k}-1.zarr" for k in (0, 1)]
        subprocess.run(
            [sys.executable, "-m", "snakemake", "--cores", "1", "--snakefile", ROOT / "Snakefile",
             "--directory", project, "--configfile", project / "config.yaml", "--quiet", "all",
             "--", *towns],
            check=True,
        )  # fmt: skip
        compare(project, name)


if __name__ == "__main__":
    main()
