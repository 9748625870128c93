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


def geoid_of_other_sign(folder: Path, undulation_m: float = 30.0) -> None:
    """Orthometric points around the control points, and a grid of -N where the geoid has N."""
    rows = make_gcps()
    x, y = pyproj.Transformer.from_crs(4326, 32650, always_xy=True).transform(
        *np.array([(row["lon"], row["lat"]) for row in rows]).T
    )
    gcps = np.column_stack([x, y, [row["height"] for row in rows]])
    around = np.random.default_rng(4).uniform((-4, -4, -0.1), (4, 4, 0.1), (15, 200, 3))
    xyz = (gcps[:, None] + around).reshape(-1, 3) - (0, 0, undulation_m)
    write_las(folder / "lidar" / "points.laz", len(xyz), xyz=xyz, system=COMPOUND)
    write_gtx(folder / "geoid.gtx", np.full((5, 5), -undulation_m), 113.0, 28.0, 1.0)
    write_sheet(folder, geoid="geoid.gtx")


def _without(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def _blunders(rows: list[dict]) -> None:
    rng = np.random.default_rng(5)
    for row in rows[:8]:
        row["left_col"] += rng.uniform(40, 200)
        row["left_row"] -= rng.uniform(40, 200)


COMPOUND = pyproj.CRS("EPSG:32650+5773")
ZONE_51 = pyproj.CRS("EPSG:32651").to_3d()
# One of each kind: what readers and stages refuse besides, their own tests have.
FAULTS = [
    Fault("value out of range", "tiles.size", lambda f: write_settings(f, tiles={"size": 4})),
    Fault("column", "column 'lidar_crs' is missing", _replaced("scenes.tsv", "lidar_crs", "crs")),
    Fault("no scene", "no scene in it",
          lambda f: (f / "scenes.tsv").write_text("\t".join(SHEET_COLUMNS))),
    Fault("no left image", "left_image", _without("left.tif")),
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
    Fault("damaged block", "is damaged", _flipped),
    Fault("nothing but nodata", "no pixel but nodata",
          lambda f: write_image(f / "left.tif", RPCS["left"], SIZES["left"])),
    Fault("map-projected", "map grid and has an RPC", on_grid),
    Fault("RPC cut short", "malformed RPC", lambda f: (_rpb("left")(f), _cut("left.rpb")(f))),
    Fault("RPC of other ground", "the other image and the GCPs are elsewhere",
          _rpb("right", long_off=LON + 6)),
    Fault("RPC of another size", "pixels would be", _rpb("right", samp_scale=9e6, line_scale=9e6)),
    Fault("one view twice", "one direction",
          lambda f: (with_pixels(write_image(f / "right.tif", RPCS["left"], SIZES["left"])),
                     write_sheet(f, gcps=""))),
    Fault("GCP column", "column 'left_row' is missing",
          _replaced("gcps.csv", "left_row", "leftrow")),
    Fault("GCPs elsewhere", "far from the ground", _gcps(_each(lon=lambda r: r["lon"] + 3))),
    Fault("GCPs contradict each other", "do not fit the image", _gcps(_blunders)),
    Fault("no CRS", "no coordinate reference system", _lidar(system=None)),
    Fault("LAZ cut short", "truncated", _cut("lidar/points.laz", 0.7)),
    Fault("LiDAR of the next zone", "degrees away", _lidar(system=ZONE_51)),
    Fault("LiDAR of other ground", "no overlap", _lidar(lat=LAT + 0.2)),
    Fault("swapped lon and lat", "Remedy",
          lambda f: write_las(f / "lidar/points.laz", 2000, scale=1e-7, system=pyproj.CRS(4979),
                              xyz=np.random.default_rng(1).uniform(
                                  (LAT - 0.01, LON - 0.01, 30), (LAT + 0.01, LON + 0.01, 99),
                                  (2000, 3)))),
    Fault("orthometric heights", "orthometric", _lidar(system=COMPOUND)),
    Fault("geoid elsewhere", "outside the geoid grid",
          lambda f: (write_lidar(f, system=COMPOUND), _geoid(f))),
    Fault("geoid of the other sign", "this geoid the LiDAR lies 60.0 m too low, at 15",
          geoid_of_other_sign),
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
