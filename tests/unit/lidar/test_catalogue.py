"""Catalogues of tiles: read in each form, believed in nothing that leads elsewhere."""

from __future__ import annotations

import json

import geopandas
import numpy as np
import pyproj
import pytest
import shapely

from stereotruth.core.errors import InputError
from stereotruth.lidar.catalogue import Tile, cover_of, read_catalogue, resolved
from stereotruth.lidar.lattice import CELL_DEG, Footprint

WEST, SOUTH = 5.0, 43.0
SIDE = 0.01


def square(k=0, row=0, side=SIDE):
    west, south = WEST + k * side, SOUTH + row * side
    return shapely.box(west, south, west + side, south + side).exterior.coords[:]


def item(k=0, **properties):
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "geometry": {"type": "Polygon", "coordinates": [square(k)]},
        "properties": {"pc:count": 1000 + k, "datetime": f"2021-05-0{k + 1}T23:30:00-02:00"}
        | properties,
        "assets": {
            "overview": {"href": "./small.copc.laz", "roles": ["overview"]},
            "data": {"href": f"./tile_{k}.copc.laz", "roles": ["data"]},
        },
    }


def collection(items):
    return {"type": "FeatureCollection", "features": items}


def index(n=3, **more):
    columns = [
        {"name": f"T{k}", "file": f"tiles/t{k}.laz", "day": "2020-02-03"} | more for k in range(n)
    ]
    return collection([polygon(square(k)) | {"type": "Feature", "properties": row}
                       for k, row in enumerate(columns)])  # fmt: skip


def polygon(ring):
    return {"geometry": {"type": "Polygon", "coordinates": [ring]}}


def read(folder, content, name="tiles.json", **how):
    file = folder / name
    file.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return read_catalogue(str(file), **how).tiles


def test_stac_items_have_location_outline_dates_and_points(tmp_path):
    tiles = read(tmp_path, collection([item(0), item(1)]))
    assert [tile.href for tile in tiles] == ["./tile_0.copc.laz", "./tile_1.copc.laz"]
    assert [tile.points for tile in tiles] == [1000, 1001]
    assert tiles[0].start == tiles[0].end == "2021-05-02"  # of UTC
    assert np.allclose(tiles[1].outline.bounds, [WEST + SIDE, SOUTH, WEST + 2 * SIDE, SOUTH + SIDE])


def test_the_day_of_a_vpc_is_that_of_writing(tmp_path):
    assert read(tmp_path, item(0), "a.vpc")[0].start == ""
    spans = {"start_datetime": "2020-01-01T00:00:00Z", "end_datetime": "2020-03-01T00:00:00Z"}
    (tile,) = read(tmp_path, collection([item(0, **spans)]), "b.vpc")
    assert (tile.start, tile.end) == ("2020-01-01", "2020-03-01")


@pytest.mark.parametrize("far", [None, float("inf"), 1e308])
@pytest.mark.filterwarnings("error")
def test_the_tiles_own_coordinates_come_before_degrees(tmp_path, far):
    """If they are any."""
    box = [900_000, 6_200_000, 0, 901_000, 6_201_000, 90] if far is None else [-far, -far, far, far]
    (tile,) = read(tmp_path, item(0, **{"proj:code": "EPSG:2154", "proj:bbox": box}))
    if far is not None:
        assert tile.outline.bounds == (WEST, SOUTH, WEST + SIDE, SOUTH + SIDE)
        return
    x, y = np.meshgrid(np.linspace(900_000, 901_000, 9), np.linspace(6_200_000, 6_201_000, 9))
    lon, lat = pyproj.Transformer.from_crs(2154, 4326, always_xy=True).transform(x, y)
    assert np.allclose(tile.outline.bounds, [lon.min(), lat.min(), lon.max(), lat.max()], atol=1e-7)
    assert pyproj.CRS(tile.crs).to_epsg() == 2154


def test_a_box_across_the_antimeridian_covers_nothing_but_itself(tmp_path):
    """Its west is east of its east (RFC 7946, section 5.2)."""
    (tile,) = read(tmp_path, item(0) | {"geometry": None, "bbox": [179.99, -17.0, -179.99, -16.9]})
    far, near = around(5.0, -16.96, 5.01, -16.95), around(179.992, -16.96, 179.993, -16.95)
    assert cover_of([tile], far).hole_m2 == pytest.approx(far.area_m2)
    assert cover_of([tile], near).taken == (0,) and cover_of([tile], near).hole_m2 == 0


def test_an_index_tells_its_column_of_locations(tmp_path):
    assert [t.href for t in read(tmp_path, index())] == [f"tiles/t{k}.laz" for k in range(3)]
    several = index(url="https://host/a.laz")
    with pytest.raises(InputError, match="there are file, url"):
        read(tmp_path, several)
    dated = read(tmp_path, several, column="url", dates=("day", "day"))
    assert {(t.href, t.start) for t in dated} == {("https://host/a.laz", "2020-02-03")}
    with pytest.raises(InputError, match="'where'"):
        read(tmp_path, several, column="where")


def test_an_index_in_another_system_is_brought_to_degrees(tmp_path):
    change = pyproj.Transformer.from_crs(4326, 32631, always_xy=True)
    made = index(1)
    made["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}}
    made["features"][0] |= polygon([change.transform(*corner) for corner in square(0)])
    (tile,) = read(tmp_path, made)
    assert np.allclose(tile.outline.bounds, [WEST, SOUTH, WEST + SIDE, SOUTH + SIDE], atol=2e-6)


def geopackage(file, count, srs=4326):
    """A GeoPackage of one layer: polygons, and several polygons in one."""
    outlines = [shapely.Polygon(square(k)) for k in range(count)]
    outlines = [shapely.multipolygons([one]) if k % 2 else one for k, one in enumerate(outlines)]
    columns = {"name": [f"T{k}" for k in range(count)],
               "location": [f"t{k}.laz" for k in range(count)]}  # fmt: skip
    table = geopandas.GeoDataFrame(columns, geometry=outlines, crs=4326).to_crs(srs)
    table.to_file(file, layer="my tiles", driver="GPKG")
    return file.read_bytes()


def test_a_geopackage_is_read_and_a_damaged_one_refused_or_read_right(tmp_path):
    """Bytes are changed at random: what comes is an InputError or tiles, and nothing else."""
    whole = geopackage(tmp_path / "whole.gpkg", 6, 2154)
    tiles = read(tmp_path, whole, "a.gpkg")
    assert [tile.href for tile in tiles] == [f"t{k}.laz" for k in range(6)]
    for k, tile in enumerate(tiles):
        box = [WEST + k * SIDE, SOUTH, WEST + (k + 1) * SIDE, SOUTH + SIDE]
        assert np.allclose(tile.outline.bounds, box, atol=2e-6)
    rng, refused = np.random.default_rng(3), 0
    for k in range(30):
        content = bytearray(whole)
        for at in rng.integers(100, len(content), 30):
            content[at] ^= 1 << int(rng.integers(8))
        try:
            read(tmp_path, bytes(content[: rng.integers(len(content))] if k % 3 else content))
        except InputError:
            refused += 1
    assert refused > 10


DAMAGED = {
    "no JSON": b"{]",
    "deep": b"[" * 100_000,
    "a list": b"[]",
    "SQLite cut": b"SQLite format 3\0" + bytes(80),
    "a collection": {"type": "Collection", "links": []},
    "no feature": collection([7]),
    "no features": collection([]),
    "another page": collection([item(0)]) | {"links": [{"rel": "next", "href": "x"}]},
    "more matched": collection([item(0)]) | {"numberMatched": 12},
    "no outline": item() | {"geometry": None},
    "off the Earth": item() | polygon([[900, 9]] * 4),
    "beyond all numbers": item() | polygon([[10**400, 1]] * 4),
    "a box of three": item() | {"geometry": None, "bbox": [1, 2, 3]},
    "no data": item() | {"assets": {}},
    "in a ZIP": item() | {"assets": {"d": {"href": "a.zip"}, "e": 1}},
    "two files": item() | {"assets": {"a": {"href": "a.laz"}, "b": {"href": "b.laz"}}},
}


@pytest.mark.parametrize("fault", DAMAGED)
def test_a_damaged_catalogue_is_refused(tmp_path, fault):
    with pytest.raises(InputError) as error:
        read(tmp_path, DAMAGED[fault])
    assert error.value.file.endswith("tiles.json") and error.value.remedy


WEB, DISK = "https://data.example.org/lidar/index.json", "lidar/tiles.vpc"
HOSTS = frozenset({"tiles.example.org"})  # that the user allows
B = "https://tiles.example.org/b.laz"


@pytest.mark.parametrize(
    ("catalogue", "href", "where"),
    [
        (WEB, "../other/a.laz", "https://data.example.org/other/a.laz"),
        (WEB, "/a.laz", "https://data.example.org/a.laz"),
        (WEB, B, B),
        (DISK, B, B),
        (DISK, "./a.laz", "lidar/a.laz"),
        (DISK, "/data/a.laz", "/data/a.laz"),
        ("s3://bucket/x/i.json", "sub/a.laz", "s3://bucket/x/sub/a.laz"),
        *((WEB, href, "") for href in (
            "FILE:///etc/passwd", "https://evil.example/a.laz", "//evil.example/a.laz",
            "https://data.example.org@evil.example/a.laz", "https://data.example.org:8443/a.laz",
            "http://tiles.example.org/a.laz",  # came by https itself
            "ftp://tiles.example.org/a.laz",  # an allowed host, by another scheme
            "data:text/plain,x", "https://[::1/a.laz", "a\nb.laz", "a;b.laz",
        )),
        *((DISK, href, "") for href in ("file:///etc/passwd", "//evil.example/a", "s3://b/a.laz")),
        ("s3://bucket/x/i.json", "s3://other/a.laz", ""),
    ],
)  # fmt: skip
def test_a_catalogue_leads_to_its_own_origin_and_to_allowed_hosts(catalogue, href, where):
    if where:
        assert resolved(href, catalogue, HOSTS) == where
        return
    with pytest.raises(InputError):
        resolved(href, catalogue, HOSTS)


def around(west, south, east, north):
    """A footprint of the cells that a box touches."""
    outline = np.array([[west, east, east, west], [south, south, north, north]])
    return Footprint.around([outline], 0.0)


def tile(ring, href="a.laz"):
    return Tile(href, shapely.Polygon(ring))


def test_taken_tiles_are_all_that_share_a_place_with_the_footprint():
    """Against places strewn over random triangles: whatever has one in the footprint is taken."""
    rng = np.random.default_rng(5)
    footprint = around(WEST, SOUTH, WEST + 2 * SIDE, SOUTH + 2 * SIDE)
    for _ in range(100):
        corners = np.array([WEST, SOUTH]) + SIDE * rng.uniform(-4, 6, (3, 2))
        weights = rng.dirichlet([0.5] * 3, 500)
        col, row = np.floor((weights @ corners).T / CELL_DEG).astype(int)
        col, row = col - footprint.col, row - footprint.row
        inside = (col >= 0) & (row >= 0)
        inside &= (col < footprint.held.shape[1]) & (row < footprint.held.shape[0])
        if footprint.held[row[inside], col[inside]].any():
            assert cover_of([tile(corners)], footprint).taken == (0,)


def test_ground_that_no_tile_covers_is_named_with_its_area():
    tiles = [tile(square(k, row)) for row in range(3) for k in range(3) if (k, row) != (1, 1)]
    footprint = around(WEST + 0.1 * SIDE, SOUTH + 0.1 * SIDE, WEST + 2.9 * SIDE, SOUTH + 2.9 * SIDE)
    cover = cover_of(tiles, footprint)
    wanted = (111_195 * SIDE) ** 2 * np.cos(np.radians(SOUTH + 1.5 * SIDE))
    assert abs(cover.hole_m2 / wanted - 1) < 0.02
    assert WEST + SIDE < cover.hole_at[0] < WEST + 2 * SIDE
    assert SOUTH + SIDE < cover.hole_at[1] < SOUTH + 2 * SIDE


def test_doubled_tiles_are_named():
    tiles = [tile(square(0)), tile(square(1)), tile(square(1), "again.laz"), tile(square(2))]
    footprint = around(WEST, SOUTH, WEST + 3 * SIDE, SOUTH + SIDE)
    assert cover_of(tiles, footprint).doubled == ((1, 2),)
