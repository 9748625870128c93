"""One door: what a height, a place and a value mean is read in one way wherever it enters.

A kind is a raster of one truth, written in one of the ways that the world writes rasters: in feet,
tenths, another projection, without a nodata value … The reader takes each kind, and each door some:
either as the truth, or it refuses the file by name with a remedy. Nothing is taken otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

from stereotruth.align.control_points import read_gcps
from stereotruth.core.errors import InputError
from stereotruth.core.numerics.geometry import continuous
from stereotruth.evaluate.surface_models import score
from stereotruth.evaluate.surface_models.reference import RasterReference
from stereotruth.evaluate.surface_models.score import score_surface_model
from stereotruth.lidar.declared_crs import LidarCRS
from stereotruth.lidar.geoid import GeoidGrid
from stereotruth.lidar.height_raster import HeightRaster
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.to_wgs84 import check_area
from stereotruth.project.import_gcps import import_gcps
from stereotruth.sensor.rpc import RPC

from ..synthetic.analytic_town import EPSG, NORTH, SIDE, WEST, Town, write
from ..synthetic.las import FT, US_FT, everything, write_gtx, write_las
from ..synthetic.surveyed_pair import RPCS

TOWN, CELL = Town(), 0.5
EAST_M, NORTH_M, UP_M = 2.0, -1.0, 0.5  # of the models that are scored
N_M = 11.0  # of the geoid


@dataclass(frozen=True)
class Kind:
    """A way to write heights. ``right``: what doors make of it, or words of the refusal.

    ``crs`` of the grid (EPSG code) and what the file says (``declared``); ``unit`` in metres,
    ``scale``, ``offset`` of the band; ``fill``: stored value of a twentieth of the cells, in
    blocks; ``geoid``: the heights count from it; ``given``: its grid is named.
    """

    name: str
    right: str = ""
    crs: int = EPSG
    declared: str = ""
    unit: float = 1.0
    scale: float = 1.0
    offset: float = 0.0
    dtype: str = "float32"
    fill: float | None = None
    nodata: float | None = None
    geoid: bool = False
    given: bool = False
    more: dict[str, Any] = field(default_factory=dict)


FILLS = [
    Kind(f"fill {value:g}{' scaled' * (scale != 1)}, undeclared", "which", fill=value, scale=scale,
         dtype="int16" if scale != 1 else "float32")
    for value, scale in ((-9999, 1), (0, 1), (1e20, 1), (-32768, 0.1))
]  # fmt: skip
KINDS = [
    Kind("plain"),
    Kind("degrees", crs=4326),
    Kind("Web Mercator", crs=3857),
    Kind("band in feet", unit=FT, more={"units": "ft"}),
    Kind("band in US survey feet", unit=US_FT, more={"units": "US survey foot"}),
    Kind("band in fathoms", "fathom", unit=1.8288, more={"units": "fathom"}),
    Kind("system in US survey feet", unit=US_FT, declared="feet"),
    Kind("tenths", scale=0.1, dtype="int16", fill=-32768, nodata=-32768),
    Kind("offset", scale=0.01, offset=40.0, dtype="uint16", fill=65535, nodata=65535),
    Kind("declared fill", fill=-9999, nodata=-9999),
    Kind("mask", fill=-9999, more={"mask": True}),
    Kind("alpha", fill=-9999, more={"alpha": True}),
    *FILLS,
    Kind("above EGM96", "EGM96", declared=f"EPSG:{EPSG}+5773", geoid=True),
    Kind("above EGM96, its grid given", declared=f"EPSG:{EPSG}+5773", geoid=True, given=True),
    Kind("above a geoid in feet", declared=f"EPSG:{EPSG}+6360", geoid=True, given=True, unit=US_FT),
    Kind("above an undeclared geoid, its grid given", geoid=True, given=True),
    Kind("declared ellipsoidal, a grid given", declared="3-D", given=True),
    Kind("depths", "point down", declared=f"EPSG:{EPSG}+5715", geoid=True, given=True),
    Kind("two units", "counts heights in", declared=f"EPSG:{EPSG}+5773", geoid=True, given=True,
         unit=FT, more={"units": "ft"}),
    Kind("two bands", "2 bands", more={"bands": 2}),
    Kind("turned grid", "north", more={"turned": True}),
    Kind("south up", "north", more={"south_up": True}),
    Kind("points, not areas", more={"point": True}),
]  # fmt: skip


def declared_of(kind: Kind) -> pyproj.CRS:
    """The system that the file declares."""
    plain = pyproj.CRS(kind.crs)
    if kind.declared == "feet":
        text = plain.to_wkt("WKT1_GDAL").replace(
            'UNIT["metre",1', f'UNIT["US survey foot",{US_FT!r}'
        )
        text = text.replace('AUTHORITY["EPSG","9001"]', 'AUTHORITY["EPSG","9003"]')
        return pyproj.CRS(
            text.replace(',AUTHORITY["EPSG","32650"]', "").replace("500000", str(5e5 / US_FT))
        )
    if kind.declared == "3-D":
        return plain.to_3d()
    return pyproj.CRS(kind.declared) if kind.declared else plain


def truth(east: np.ndarray, north: np.ndarray, moved: bool) -> np.ndarray:
    """Ellipsoidal heights of the town at UTM coordinates; NaN outside of it.

    ``moved``: of the model, by metres on the ground, which are 1 / 0.9996 of UTM's.
    """
    e, n, up = (EAST_M * 0.9996, NORTH_M * 0.9996, UP_M) if moved else (0.0, 0.0, 0.0)
    x, y = east - WEST, NORTH - north
    heights = TOWN.surface(x - e, y + n)[0] + up
    return np.where((x >= 0) & (y >= 0) & (x <= SIDE) & (y <= SIDE), heights, np.nan)


def write_kind(kind: Kind, path: Path, moved: bool) -> Path:
    """The town's heights as a kind of raster; cells of about half a metre."""
    system, to_kind = declared_of(kind), pyproj.Transformer.from_crs(EPSG, kind.crs, always_xy=True)
    west, south, east, north = to_kind.transform_bounds(WEST, NORTH - SIDE, WEST + SIDE, NORTH)
    n = round(SIDE / CELL)
    dx, dy = (east - west) / n, (north - south) / n
    at = Affine(dx, 0, west, 0, -dy, north)
    if kind.more.get("turned"):
        at = at * Affine.rotation(10.0)
    if kind.more.get("south_up"):
        at = Affine(dx, 0, west, 0, dy, south)
    col, row = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
    x, y = at * (col, row)
    place = to_kind.transform(x, y, direction="INVERSE")
    heights = truth(*map(np.asarray, place), moved) - N_M * kind.geoid
    missing = np.isnan(heights)
    if kind.fill is not None:
        blocks = np.random.default_rng(3).random((n // 8 + 1, n // 8 + 1)) < 0.05
        missing |= np.kron(blocks, np.ones((8, 8), bool))[:n, :n]
    stored = (np.where(missing, 50.0, heights) / kind.unit - kind.offset) / kind.scale
    dtype = np.dtype(kind.dtype)
    if dtype.kind in "iu":
        stored = np.clip(np.rint(stored), np.iinfo(dtype).min, np.iinfo(dtype).max)
    fill = np.nan if kind.fill is None else kind.fill
    if dtype.kind == "f" or kind.fill is not None:
        stored = np.where(missing, fill, stored)
    if kind.declared == "feet":
        at = Affine.scale(1 / US_FT) * at
    bands = kind.more.get("bands", 1) + bool(kind.more.get("alpha"))
    options = {"driver": "GTiff", "width": n, "height": n, "count": bands, "dtype": dtype}
    if kind.more.get("point"):
        options["AREA_OR_POINT"] = "Point"
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path, "w", crs=system.to_wkt(), transform=at, nodata=kind.nodata, **options
        ) as raster,
    ):
        raster.units = (kind.more.get("units", ""),) * bands
        raster.scales, raster.offsets = (kind.scale,) * bands, (kind.offset,) * bands
        for band in range(1, bands + 1):
            raster.write(stored.astype(dtype), band)
        if kind.more.get("alpha"):
            raster.colorinterp = (ColorInterp.gray, ColorInterp.alpha)
            raster.write((~missing * 255).astype(dtype), 2)
        if kind.more.get("mask"):
            raster.write_mask(~missing)
        if kind.more.get("point"):
            raster.update_tags(AREA_OR_POINT="Point")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("doors")
    write_gtx(folder / "egm96.gtx", np.full((9, 9), N_M), 115.0, 28.0, 0.5)
    return folder


def towns_points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longitude, latitude, height [n] on hills off the roofs."""
    x, y = (
        v.ravel() for v in np.meshgrid(np.linspace(9, SIDE - 9, 9), np.linspace(9, SIDE - 9, 9))
    )
    heights = truth(WEST + x, NORTH - y, moved=False)
    flat = np.abs(heights - 50) < 2
    to_degrees = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)
    lon, lat = to_degrees.transform(WEST + x[flat], NORTH - y[flat])
    return lon, lat, heights[flat]


def door_reader(file: Path, geoid: Path | None) -> None:
    """Heights off the fills at places, and cell by cell; none where there is none."""
    raster, (lon, lat, heights) = HeightRaster.open(file, geoid), towns_points()
    off = raster.heights_at(lon, lat) - heights
    known = np.isfinite(off)
    with rasterio.open(file) as source:
        is_rounded = np.dtype(source.dtypes[0]).kind in "iu"
        step = source.scales[0] * is_rounded
    # half a cell beside its place, a height is 0.025 m off
    assert known.mean() > 0.8 and np.abs(off[known]).max() < 0.005 + step / 2
    rows, cols = raster.shape
    cells = raster.window(slice(rows // 2, rows // 2 + 1), slice(0, cols))[0]
    x, y = np.arange(cols) * raster.cell_m[0], np.full(cols, -(rows // 2) * raster.cell_m[1])
    lon, lat, _ = raster.to_wgs84.exact(*raster.coordinates(x, y), np.zeros(cols))
    cells = cells + raster.to_wgs84.height_shift_m(lon, lat)
    to_utm = pyproj.Transformer.from_crs(4326, EPSG, always_xy=True)
    off = cells - truth(*to_utm.transform(lon, lat), moved=False)
    off = off[np.isfinite(off)]
    assert off.size > 0.9 * cols and np.percentile(np.abs(off), 97) < 0.06
    assert raster.cell_m == pytest.approx([0.5, 0.5], abs=0.03)


def door_lidar(file: Path, geoid: Path | None) -> None:
    """Points of the store against the town."""
    ingest(file, file.with_suffix(".points"), geoid=geoid)
    points = everything(PointStore(file.with_suffix(".points")))
    to_utm = pyproj.Transformer.from_crs(4326, EPSG, always_xy=True)
    off = points.height - truth(*to_utm.transform(points.lon, points.lat), moved=False)
    off = off[np.isfinite(off)]
    assert points.height.size > 100_000 and off.size > 0.99 * points.height.size
    assert np.median(np.abs(off)) < 0.03 and np.percentile(np.abs(off), 97) < 0.06


def door_score(file: Path, geoid: Path | None) -> None:
    """The shift of a model that was moved, on the ground."""
    reference = RasterReference(write(file.with_name("truth.tif"), TOWN.heights()))
    found = score_surface_model(file, reference, geoid=geoid).figures()
    moved = found["registration"]
    assert abs(moved["east_m"] - EAST_M) < 0.04 and abs(moved["north_m"] - NORTH_M) < 0.04
    assert abs(moved["up_m"] - UP_M) < 0.02
    assert found["errors"]["off steps"]["mean_absolute_m"] < 0.05


def door_reference(file: Path, geoid: Path | None) -> None:
    """The same truth as a reference of a model that was moved."""
    model = write_kind(Kind("model"), file.with_name("model.tif"), moved=True)
    moved = score_surface_model(model, RasterReference(file, geoid)).figures()["registration"]
    assert abs(moved["east_m"] - EAST_M) < 0.04 and abs(moved["north_m"] - NORTH_M) < 0.04
    assert abs(moved["up_m"] - UP_M) < 0.02


def door_heights(file: Path, geoid: Path | None) -> None:
    """Heights of control points."""
    lon, lat, heights = towns_points()
    lines = ["id,lon,lat,height,left_col,left_row,right_col,right_row"]
    for k, (east, north) in enumerate(zip(lon, lat)):
        lines.append(f"P{k:02d},{east:.10f},{north:.10f},,{k},1,{k},2")
    points, out = file.with_suffix(".csv"), file.with_suffix(".out.csv")
    points.write_text("\n".join(lines))
    import_gcps([points], out, heights=file, geoid=geoid)
    assert np.abs(read_gcps(out).height - heights).max() < 0.005


DOORS: dict[str, Callable[[Path, Path | None], None]] = {
    "reader": door_reader,
    "lidar": door_lidar,
    "score-dsm": door_score,
    "score-dsm --reference": door_reference,
    "gcps import --heights": door_heights,
}
# All doors have the one reader, which is asked for each kind; a door, for what it hands on to it.
ASKED = {
    "reader": {kind.name for kind in KINDS},
    "lidar": {"system in US survey feet", "offset", "alpha", "above a geoid in feet"}
    | {"fill 0, undeclared", "above EGM96", "south up"},
    "score-dsm": {"degrees", "above EGM96"},
    "score-dsm --reference": {"above EGM96, its grid given", "fill -9999, undeclared"},
    "gcps import --heights": {"above a geoid in feet", "depths"},
}
SLOW = pytest.mark.slow
CASES = [
    pytest.param(
        *(door, kind),
        id=f"{door}, {kind.name}",
        marks=[SLOW] * (door.startswith("score") and not kind.right),
    )
    for door in DOORS
    for kind in KINDS
    if kind.name in ASKED[door]
]


@pytest.mark.parametrize(("door", "kind"), CASES)
def test_each_kind_at_each_door_is_right_or_refused(door, kind, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(score, "GROUPS", 2)  # of the jackknife, whose σ nobody asks for here
    file = write_kind(kind, tmp_path / "a.tif", moved=door == "score-dsm")
    geoid = folder / "egm96.gtx" if kind.given else None
    if not kind.right:
        DOORS[door](file, geoid)
        return
    with pytest.raises(InputError) as error:
        DOORS[door](file, geoid)
    assert kind.right in str(error.value) and "a.tif" in str(error.value)
    assert "Remedy: " in str(error.value)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Kind("classes above EGM96", dtype="uint8", declared=f"EPSG:{EPSG}+5773"), ""),
        (Kind("two bands", dtype="uint8", more={"bands": 2}), "2 bands of uint8 are no raster of"),
        (Kind("codes of another scheme", dtype="int16", unit=0.1), "which is no class of LAS"),
        (Kind("degrees", dtype="uint8", crs=4326), "another grid"),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_each_kind_of_classes_is_right_or_refused(kind, words, tmp_path):
    """Values of some 50 to 70, as producers' own classes may be."""
    truth_file = write(tmp_path / "truth.tif", TOWN.heights())
    file = write_kind(kind, tmp_path / "classes.tif", moved=False)
    if not words:
        reference = RasterReference(truth_file, classes=file)
        found = reference.classes.window(slice(0, 9), slice(0, 9))
        np.testing.assert_array_equal(found, np.rint(TOWN.heights()[:9, :9]))
        return
    with pytest.raises(InputError, match=words) as error:
        reference = RasterReference(truth_file, classes=file)
        reference.classes.window(slice(0, 350), slice(0, 350))
    assert "classes.tif" in str(error.value) and "Remedy: " in str(error.value)


# ------------------------------------------------------------------------------------------ geoids


@dataclass(frozen=True)
class Grid:
    """A way to write undulations of some 11 m; ``right``: words of the refusal, empty if none."""

    name: str
    right: str = ""
    unit: float = 1.0
    scale: float = 1.0
    offset: float = 0.0
    dtype: str = "float32"
    fill: float | None = None
    nodata: float | None = None
    crs: str = "EPSG:4326"
    west: float = 115.0
    what: str = "geoid"
    more: dict[str, Any] = field(default_factory=dict)


GRIDS = [
    Grid("GTX", what="gtx"),
    Grid("GeoTIFF"),
    Grid("offset", scale=0.01, offset=5.0, dtype="uint16"),
    Grid("feet", unit=FT, more={"units": "ft"}),
    Grid("across the line of 180 degrees", west=175.0),
    Grid("from 0 to 360", west=180.2),
    Grid("declared fill", fill=-9999, nodata=-9999),
    *(Grid(f"fill {v:g}, undeclared", "which", fill=v) for v in (-9999, 0)),
    Grid("shifts in plan", "horizontal offset", more={"tags": {"TYPE": "HORIZONTAL_OFFSET"}}),
    Grid("shifts between datums", "vertical offset vertical to vertical",
         more={"tags": {"TYPE": "VERTICAL_OFFSET_VERTICAL_TO_VERTICAL"}}),
    Grid("shifts between datums, GTX", "shifts between two datums", what="shifts"),
    Grid("heights of mountains", "which is no undulation", what="mountains"),
    Grid("heights of a plain", "rougher than a geoid", what="plain"),
    Grid("in metres", "longitude and latitude", crs="EPSG:32650"),
    Grid("south up", "north-up", more={"south_up": True}),
]  # fmt: skip


@pytest.mark.parametrize("kind", GRIDS, ids=lambda kind: kind.name)
def test_each_kind_of_geoid_is_right_or_refused(kind, tmp_path):
    n, step = 121, 0.05
    lon, lat = kind.west + step * np.arange(n), 32.0 - step * np.arange(n)

    def undulation(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        return 11.0 + 0.5 * np.sin(np.radians(40 * lon)) + 0.3 * np.cos(np.radians(30 * lat))

    values = undulation(lon[None, :], lat[:, None])
    rng = np.random.default_rng(0)
    values = {"shifts": 0.1 * values, "mountains": 40 * values,
              "plain": values + rng.normal(0, 20, values.shape)}.get(kind.what, values)  # fmt: skip
    missing = np.zeros(values.shape, bool)
    missing[:9, 40:70] = kind.fill is not None
    path = tmp_path / ("g.gtx" if kind.what in ("gtx", "shifts") else "g.tif")
    if path.suffix == ".gtx":
        write_gtx(path, values[::-1], kind.west, 32.0 - step * (n - 1), step)
    else:
        at = Affine(step, 0, kind.west - step / 2, 0, -step, 32.0 + step / 2)
        at = at * Affine.rotation(10.0) if kind.more.get("turned") else at
        at = at * Affine.scale(1, -1) if kind.more.get("south_up") else at
        stored = (values / kind.unit - kind.offset) / kind.scale
        stored = np.rint(stored) if np.dtype(kind.dtype).kind in "iu" else stored
        stored = np.where(missing, kind.fill or 0, stored)
        bands = kind.more.get("bands", 1)
        with rasterio.open(
            path, "w", driver="GTiff", width=n, height=n, count=bands, dtype=kind.dtype,
            crs=kind.crs, transform=at, nodata=kind.nodata,
        ) as grid:  # fmt: skip
            grid.units = (kind.more.get("units", ""),) * bands
            grid.scales, grid.offsets = (kind.scale,) * bands, (kind.offset,) * bands
            grid.update_tags(**kind.more.get("tags", {}))
            for band in range(1, bands + 1):
                grid.write(stored.astype(kind.dtype), band)
    places = kind.west + rng.uniform(0.1, 5.9, 500), rng.uniform(26.1, 31.0, 500)
    if kind.right:
        with pytest.raises(InputError) as error:
            GeoidGrid(path)(places[0], np.append(places[1][1:], 31.9))
        assert kind.right in str(error.value) and path.name in str(error.value)
        assert "Remedy: " in str(error.value)
        return
    found = GeoidGrid(path)((places[0] + 180) % 360 - 180, places[1])
    np.testing.assert_allclose(found, undulation(*places), atol=0.006)


# ------------------------------------------------------------------------------- control points


def written(heights: float, crs: str, place: tuple[float, float], suffix: str, head: str) -> str:
    """A point at a place in a system, as the formats have it."""
    x, y = pyproj.Transformer.from_crs(4326, crs or 4326, always_xy=True).transform(*place)
    if suffix == ".gcp":
        return f"{head}P1 {place[1]:.10f} {place[0]:.10f} {heights} 1 1 1 l 1 2 1 1 r 3 4 1 1\n"
    columns = "id,lon,lat,height,left_col,left_row,right_col,right_row"
    return f"{head}{columns}\nP1,{x:.10f},{y:.10f},{heights},1,2,3,4\n"


POINTS = [
    ("degrees above a geoid", "", 29.0, {"geoid": True}, "", 40.0),
    ("above EGM96", "EPSG:32650+5773", 29.0, {}, "", "heights are orthometric ('EGM96 height')"),
    ("said by the file", "EPSG:32650+5773", 29.0, {"unsaid": True}, "# CRS: {crs}\n",
     "heights are orthometric"),
    ("said by the file, grid given", "EPSG:32650+5773", 29.0, {"unsaid": True, "geoid": True},
     "# WKT: {wkt}\n", 40.0),
    ("in US survey feet", "EPSG:32650+6360", 29.0 / US_FT, {"geoid": True}, "", 40.0),
    ("ellipsoidal, grid given", "EPSG:4979", 40.0, {"geoid": True}, "", 40.0),
    ("depths", "EPSG:32650+5715", -29.0, {"geoid": True}, "", "point down"),
    (".gcp above a geoid", "EPSG:4326+5773", 29.0, {"unsaid": True}, "# WKT: {wkt}\n",
     "heights are orthometric"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "crs", "height", "how", "head", "right"), POINTS, ids=str)
def test_control_points_mean_what_their_system_says(
    kind, crs, height, how, head, right, folder, tmp_path
):
    place = (117.001, 29.829)
    file = tmp_path / ("a.gcp" if kind.startswith(".gcp") else "a.csv")
    known = crs not in ("", "EPSG:99")
    wkt = pyproj.CRS(crs).to_wkt("WKT1_GDAL") if "{wkt}" in head else ""
    text = written(height, crs if known else "", place, file.suffix, head.format(crs=crs, wkt=wkt))
    file.write_text(text)
    options = {"crs": "" if how.get("unsaid") else crs}
    options |= {"geoid": folder / "egm96.gtx"} if how.get("geoid") else {}
    if isinstance(right, str):
        with pytest.raises(InputError) as error:
            import_gcps([file], tmp_path / "out.csv", **options)
        assert right in str(error.value) and file.name in str(error.value)
        assert "Remedy: " in str(error.value) and not (tmp_path / "out.csv").exists()
        return
    import_gcps([file], tmp_path / "out.csv", **options)
    found = read_gcps(tmp_path / "out.csv")
    assert (found.lon[0], found.lat[0]) == pytest.approx(place, abs=1e-8)
    assert found.height[0] == pytest.approx(right, abs=2e-3)


# ------------------------------------------------------------------------------ points of LiDAR


def test_points_that_nobody_measured_are_named(tmp_path):
    """Half of them flagged as synthetic, 7 m lower; of both kinds of records."""
    for pdrf, version in ((6, "1.4"), (1, "1.2")):
        file, flags = tmp_path / f"{pdrf}.las", np.arange(3000) % 2
        write_las(file, pdrf=pdrf, version=version, synthetic=flags)
        found = ingest(file, tmp_path / "a.points")
        assert "1500 of 3000 points" in found["doubts"][0] and "synthetic" in found["doubts"][0]
        write_las(file, pdrf=pdrf, version=version)
        assert ingest(file, tmp_path / "a.points")["doubts"] == []


@pytest.mark.parametrize("epsg", [32660, 32601])
def test_points_across_the_line_of_180_degrees_lie_side_by_side(epsg, tmp_path):
    """Where one degree east of the line is one degree more than 180, whatever the zone says."""
    to_utm = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
    x, y = to_utm.transform(180.0, 30.0)
    rng = np.random.default_rng(1)
    xyz = np.column_stack([x + rng.uniform(-300, 300, 4000), y + rng.uniform(-300, 300, 4000),
                           20 + 0.002 * rng.permutation(4000)])  # fmt: skip
    xyz = write_las(tmp_path / "a.las", 4000, xyz=xyz, system=pyproj.CRS(epsg).to_3d())
    found = ingest(tmp_path / "a.las", tmp_path / "a.points")
    west, _, east, _ = found["bounds"][:4]
    assert 179.99 < west < 180 < east < 180.01 and not any("area" in n for n in found["notes"])
    store = PointStore(tmp_path / "a.points")
    points = store.query(179.0, 29.0, 181.0, 31.0)
    back = np.column_stack([*to_utm.transform(points.lon, points.lat), points.height])
    order, exact = np.argsort(back[:, 2]), np.argsort(xyz[:, 2])
    np.testing.assert_allclose(back[order], xyz[exact], atol=2e-3)


def test_longitudes_are_compared_on_a_circle():
    rpc = RPCS["left"].to_dict()
    for given in (179.99, -179.99, 180.01):
        at = RPC.from_dict(rpc | {"long_off": given}).localize(2000, 1500, 60.0)
        assert 179.9 < at[0] < 180.1
    assert RPC.from_dict(rpc).long_off == rpc["long_off"]
    lon = np.array([-177.6, 182.39, 244.0, -180.0, np.inf])
    assert continuous(lon).tolist() == [-177.6, 182.39, -116.0, 180.0, np.inf]
    area = LidarCRS(pyproj.CRS(32601))
    assert check_area(area, (179.99, 180.2), (10, 11), "a.las") is None
    with pytest.raises(InputError, match="outside of the area"):
        check_area(area, (160.0, 160.1), (10, 11), "a.las")
