"""A project of one good scene, and the ways in which a user's first scene is broken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
import rasterio
import yaml
from rasterio.transform import from_origin
from rasterio.windows import Window

from .las import write_gtx, write_las
from .project import SHEET_COLUMNS
from .rpc_texts import rpb_text
from .surveyed_pair import LAT, LON, RPCS, SIZES, make_gcps, write_gcps, write_image

UTM = pyproj.CRS("EPSG:32650").to_3d()
SETTINGS = {"scenes": "scenes.tsv", "cities": "cities.tsv", "tiles": {"min_labelled": 0}}
ROW = {
    "scene": "Good-1",
    "city": "Good",
    "left_image": "left.tif",
    "right_image": "right.tif",
    "lidar": "lidar",
    "gcps": "gcps.csv",
}
CITIES = "city\tprefix\ttraining\tvalidation\ttesting\nGood\tGD\t6\t1\t3\n"


def write_sheet(folder: Path, **changes: str) -> None:
    row = ROW | changes
    cells = "\t".join(row.get(column, "") for column in SHEET_COLUMNS)
    (folder / "scenes.tsv").write_text("\t".join(SHEET_COLUMNS) + f"\n{cells}\n")


def write_settings(folder: Path, **changes: object) -> None:
    (folder / "config.yaml").write_text(yaml.safe_dump(SETTINGS | changes))


def write_lidar(
    folder: Path,
    name: str = "points.laz",
    *,
    lon: float = LON,
    lat: float = LAT,
    system: pyproj.CRS | None = UTM,
    lift: float = 0.0,
    moved: tuple[float, float] = (0.0, 0.0),
    **options: object,
) -> Path:
    """20 000 points around a place, heights 25 to 115 m, in UTM zone 50N if ``system`` is."""
    rng = np.random.default_rng(3)
    east, north = rng.uniform(-0.012, 0.012, 20_000), rng.uniform(-0.008, 0.008, 20_000)
    x, y = pyproj.Transformer.from_crs(4326, 32650, always_xy=True).transform(
        lon + east, lat + north
    )
    xyz = np.column_stack([x + moved[0], y + moved[1], rng.uniform(25, 115, 20_000) + lift])
    file = folder / "lidar" / name
    file.parent.mkdir(exist_ok=True)
    write_las(file, len(xyz), xyz=xyz, system=system, **options)
    return file


def with_pixels(image: Path) -> Path:
    """The image, of which some blocks have a value."""
    with rasterio.open(image, "r+") as dataset:
        dataset.write(np.full((256, 256), 500, "uint16"), 1, window=Window(1024, 1024, 256, 256))
    return image


def good_project(folder: Path) -> Path:
    """A project that a check has nothing to say against."""
    folder.mkdir(parents=True, exist_ok=True)
    for view in ("left", "right"):
        with_pixels(write_image(folder / f"{view}.tif", RPCS[view], SIZES[view]))
    write_gcps(folder / "gcps.csv", make_gcps())
    write_lidar(folder)
    write_sheet(folder)
    write_settings(folder)
    (folder / "cities.tsv").write_text(CITIES)
    return folder


@dataclass(frozen=True)
class Fault:
    """A way to break a project, and words of what has to be said of it."""

    name: str
    words: str
    plant: Callable[[Path], object]


def _gcps(change: Callable[[list[dict]], object], n: int = 15) -> Callable[[Path], object]:
    def plant(folder: Path) -> None:
        rows = make_gcps(n)
        write_gcps(folder / "gcps.csv", change(rows) or rows)

    return plant


def _each(**changes: Callable[[dict], object]) -> Callable[[list[dict]], list[dict]]:
    return lambda rows: [row | {k: f(row) for k, f in changes.items()} for row in rows]


def _cut(name: str, share: float = 0.5) -> Callable[[Path], object]:
    def plant(folder: Path) -> None:
        file = folder / name
        data = file.read_bytes()
        file.write_bytes(data[: int(len(data) * share)])

    return plant


def _rpb(view: str, **changes: object) -> Callable[[Path], object]:
    return lambda folder: (folder / f"{view}.rpb").write_text(
        rpb_text(replace(RPCS[view], **changes).to_dict())
    )


def _lidar(**options: object) -> Callable[[Path], object]:
    return lambda folder: write_lidar(folder, **options)


def _named(name: str, **options: object) -> Callable[[Path], object]:
    def plant(folder: Path) -> None:
        (folder / "lidar" / "points.laz").unlink()
        write_lidar(folder, name, **options)

    return plant


def _replaced(file: str, old: str, new: str) -> Callable[[Path], object]:
    def plant(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return plant


def _pixels(dtype: str, **options: object) -> Callable[[Path], object]:
    def plant(folder: Path) -> None:
        cols, rows = SIZES["left"]
        shape = {"width": cols, "height": rows, "count": 1, "dtype": dtype}
        with rasterio.open(folder / "left.tif", "w", driver="GTiff", **shape, **options) as ds:
            ds.write(np.ones((rows, cols), dtype), 1)
        (folder / "left.rpb").write_text(rpb_text(RPCS["left"].to_dict()))

    return plant


def on_grid(folder: Path, gsd: float = 0.7) -> None:
    """The left image on a map grid, north up, with its RPC; 0.65 m is what that says."""
    cols, rows = SIZES["left"]
    x, y = pyproj.Transformer.from_crs(4326, 32650, always_xy=True).transform(LON, LAT)
    with rasterio.open(folder / "left.tif", "r+") as dataset:
        dataset.crs = "EPSG:32650"
        dataset.transform = from_origin(x - cols / 2 * gsd, y + rows / 2 * gsd, gsd, gsd)


def _flipped(folder: Path) -> None:
    _pixels("uint16", compress="deflate", tiled=True)(folder)
    data = bytearray((folder / "left.tif").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / "left.tif").write_bytes(data)


def _geoid(folder: Path) -> None:
    write_gtx(folder / "geoid.gtx", np.full((5, 5), 30.0), 0.0, 40.0, 1.0)
    write_sheet(folder, geoid="geoid.gtx")


def _without(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def _blunders(rows: list[dict]) -> None:
    rng = np.random.default_rng(5)
    for row in rows[:8]:
        row["left_col"] += rng.uniform(40, 200)
        row["left_row"] -= rng.uniform(40, 200)


def _on_a_line(rows: list[dict]) -> list[dict]:
    from stereotruth.sensor.rpc import SensorModel

    for k, row in enumerate(rows):
        row["lon"], row["lat"] = LON - 0.008 + 0.001 * k, LAT
        for view in ("left", "right"):
            place = SensorModel(RPCS[view]).project(row["lon"], row["lat"], row["height"])
            row[f"{view}_col"], row[f"{view}_row"] = map(float, place)
    return rows


COMPOUND = pyproj.CRS("EPSG:32650+5773")
ZONE_51, SOUTH = pyproj.CRS("EPSG:32651").to_3d(), pyproj.CRS("EPSG:32750").to_3d()
FAULTS = [
    Fault("unknown key", "unknown key 'tile'", lambda f: write_settings(f, tile=1)),
    Fault("value out of range", "tiles.size", lambda f: write_settings(f, tiles={"size": 4})),
    Fault("no YAML", "cannot be read as YAML", lambda f: (f / "config.yaml").write_text("a: [")),
    Fault(
        "stride",
        "share no common step",
        lambda f: write_settings(f, tiles={"size": 1024, "stride": 1023, "min_labelled": 0}),
    ),
    Fault("column", "column 'lidar_crs' is missing", _replaced("scenes.tsv", "lidar_crs", "crs")),
    Fault("unknown city", "not in cities.tsv", lambda f: write_sheet(f, city="God")),
    Fault("one image twice", "one image twice", lambda f: write_sheet(f, right_image="left.tif")),
    Fault("no scene", "no scene in it",
          lambda f: (f / "scenes.tsv").write_text("\t".join(SHEET_COLUMNS))),
    Fault("no left image", "left_image", _without("left.tif")),
    Fault("no GCP file", "does not exist", _without("gcps.csv")),
    Fault("no LiDAR", "no LiDAR file", _without("lidar/points.laz")),
    Fault(
        "no GCPs, no refinement",
        "alignment.refine is false",
        lambda f: (write_sheet(f, gcps=""), write_settings(f, alignment={"refine": False})),
    ),
    Fault(
        "fixed alignment", "no such file",
        lambda f: write_settings(f, alignment={"fixed": {"Good-1": "none.json"}}),
    ),
    Fault("image cut short", "left.tif", _cut("left.tif", 0.3)),
    Fault("no image", "left.tif", lambda f: (f / "left.tif").write_text("<html>404</html>")),
    Fault("complex image", "complex image", _pixels("complex64", compress="deflate")),
    Fault("damaged block", "is damaged", _flipped),
    Fault("nothing but nodata", "no pixel but nodata",
          lambda f: write_image(f / "left.tif", RPCS["left"], SIZES["left"])),
    Fault("map-projected", "map grid and has an RPC", on_grid),
    Fault("no RPC", "no RPC metadata",
          lambda f: (_pixels("uint8")(f), (f / "left.rpb").unlink())),
    Fault("RPC cut short", "malformed RPC", lambda f: (_rpb("left")(f), _cut("left.rpb")(f))),
    Fault("RPC of other ground", "the other image and the GCPs are elsewhere",
          _rpb("right", long_off=LON + 6)),
    Fault("RPC of another size", "pixels would be", _rpb("right", samp_scale=9e6, line_scale=9e6)),
    Fault("one view twice", "one direction",
          lambda f: (with_pixels(write_image(f / "right.tif", RPCS["left"], SIZES["left"])),
                     write_sheet(f, gcps=""))),
    Fault("GCP column", "column 'left_row' is missing",
          _replaced("gcps.csv", "left_row", "leftrow")),
    Fault("GCPs separated by semicolons", "separated by commas",
          _replaced("gcps.csv", ",", ";")),
    Fault("GCP no number", "is no number", _gcps(lambda rows: rows[3].update(lon="12°3"))),
    Fault("GCP twice", "both have the id", _gcps(lambda rows: rows[3].update(id="G01"))),
    Fault("GCPs swapped lon and lat", "swapped",
          _gcps(_each(lon=lambda r: r["lat"], lat=lambda r: r["lon"]))),
    Fault("GCPs elsewhere", "far from the ground", _gcps(_each(lon=lambda r: r["lon"] + 3))),
    Fault("GCPs projected", "no degrees", _gcps(_each(lon=lambda r: 5e5, lat=lambda r: 3.3e6))),
    Fault("GCP heights in mm", "not of this Earth",
          _gcps(_each(height=lambda r: 1e3 * r["height"]))),
    Fault("two GCPs", "needs 4", _gcps(lambda rows: rows[:2])),
    Fault("GCPs on a line", "along one line", _gcps(_on_a_line)),
    Fault("GCP outside the image", "outside the left image",
          _gcps(lambda rows: rows[2].update(left_col=9000.0))),
    Fault("images exchanged", "seem to be swapped",
          lambda f: write_sheet(f, left_image="right.tif", right_image="left.tif")),
    Fault("columns and rows exchanged", "left image",
          _gcps(_each(left_col=lambda r: r["left_row"], left_row=lambda r: r["left_col"]))),
    Fault("GCPs contradict each other", "do not fit the image", _gcps(_blunders)),
    Fault("no CRS", "no coordinate reference system", _lidar(system=None)),
    Fault("lidar_crs", "cannot be used",
          lambda f: (write_lidar(f, system=None), write_sheet(f, lidar_crs="EPSG:99999"))),
    Fault("LAZ cut short", "truncated", _cut("lidar/points.laz", 0.7)),
    Fault("LAS cut short", "truncated",
          lambda f: (_named("points.las")(f), _cut("lidar/points.las", 0.7)(f))),
    Fault("no LAS", "no readable LAS", lambda f: (f / "lidar/points.laz").write_text("404")),
    Fault("LiDAR of the next zone", "degrees away", _lidar(system=ZONE_51)),
    Fault("LiDAR of the other hemisphere", "Remedy", _lidar(system=SOUTH)),
    Fault("LiDAR of other ground", "no overlap", _lidar(lat=LAT + 0.2)),
    Fault("LiDAR six degrees away", "degrees away", _lidar(lon=LON + 6, system=UTM)),
    Fault("swapped lon and lat", "Remedy",
          lambda f: write_las(f / "lidar/points.laz", 2000, scale=1e-7, system=pyproj.CRS(4979),
                              xyz=np.random.default_rng(1).uniform(
                                  (LAT - 0.01, LON - 0.01, 30), (LAT + 0.01, LON + 0.01, 99),
                                  (2000, 3)))),
    Fault("degrees as metres", "look like degrees",
          lambda f: write_las(f / "lidar/points.laz", 2000, scale=1e-7, system=UTM,
                              xyz=np.random.default_rng(1).uniform(
                                  (LON - 0.01, LAT - 0.01, 30), (LON + 0.01, LAT + 0.01, 99),
                                  (2000, 3)))),
    Fault("orthometric heights", "orthometric", _lidar(system=COMPOUND)),
    Fault("datum in the name", "declares no vertical datum",
          _named("tile_IGN69.laz", system=pyproj.CRS(32650))),
    Fault("geoid elsewhere", "outside the geoid grid",
          lambda f: (write_lidar(f, system=COMPOUND), _geoid(f))),
    Fault("coarse steps", "stored in steps", _lidar(scale=2.0)),
    Fault("tile too large", "not one tile of",
          lambda f: write_settings(f, tiles={"size": 4096, "min_labelled": 0})),
    Fault("too few points", "min_labelled asks",
          lambda f: write_settings(f, tiles={"min_labelled": 0.5})),
]  # fmt: skip
# What a run gets through, and what would not be what was wanted.
DOUBTS = [
    Fault("datum 200 m off", "GCPs lie", _lidar(lift=200.0)),
    Fault("heights of no declared datum", "no vertical datum", _lidar(system=pyproj.CRS(32650))),
    Fault("one file elsewhere", "lie outside the images",
          lambda f: write_lidar(f, "far.laz", lat=LAT + 1)),
    Fault("a blunder among the GCPs", "left out",
          _gcps(lambda rows: rows[4].update(left_col=rows[4]["left_col"] + 30))),
]  # fmt: skip
