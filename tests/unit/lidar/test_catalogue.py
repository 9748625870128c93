"""Catalogues of tiles: read in each form, believed in nothing that leads elsewhere."""

from __future__ import annotations

import json

import geopandas
import numpy as np
import pyproj
import pytest
import shapely

from stereotruth.core.errors import InputError
from stereotruth.core.products import remote_files
from stereotruth.core.products.remote_files import hosts_of, url_of
from stereotruth.lidar.catalogue import Tile, cover_of, read_catalogue, resolved
from stereotruth.lidar.catalogue_list import (
    ListedTile,
    TileList,
    files_of_list,
    is_catalogue,
    is_list,
    read_list,
    remarks_on,
    unlisted_m2,
    write_list,
)
from stereotruth.lidar.lattice import CELL_DEG, Footprint

WEST, SOUTH = 5.0, 43.0
SIDE = 0.01


def square(k=0, row=0, side=SIDE):
    west, south = WEST + k * side, SOUTH + row * side
    return [
        [west, south],
        [west + side, south],
        [west + side, south + side],
        [west, south + side],
        [west, south],
    ]


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
    rows = [
        {
            "type": "Feature",
            "properties": {"name": f"T{k}", "file": f"tiles/t{k}.laz", "day": "2020-02-03"} | more,
            "geometry": {"type": "Polygon", "coordinates": [square(k)]},
        }
        for k in range(n)
    ]
    return collection(rows)


def written(folder, content, name="tiles.json"):
    file = folder / name
    file.write_text(json.dumps(content))
    return str(file)


def test_stac_items_have_location_outline_dates_and_points(tmp_path):
    tiles = read_catalogue(written(tmp_path, collection([item(0), item(1)]))).tiles
    assert [tile.href for tile in tiles] == ["./tile_0.copc.laz", "./tile_1.copc.laz"]
    assert [tile.points for tile in tiles] == [1000, 1001]
    assert tiles[0].start == tiles[0].end == "2021-05-02"  # of UTC
    assert np.allclose(tiles[1].outline.bounds, [WEST + SIDE, SOUTH, WEST + 2 * SIDE, SOUTH + SIDE])


def test_one_item_is_a_catalogue_and_the_day_of_a_vpc_is_that_of_writing(tmp_path):
    assert len(read_catalogue(written(tmp_path, item(0))).tiles) == 1
    assert read_catalogue(written(tmp_path, collection([item(0)]), "a.vpc")).tiles[0].start == ""
    spans = {"start_datetime": "2020-01-01T00:00:00Z", "end_datetime": "2020-03-01T00:00:00Z"}
    tile = read_catalogue(written(tmp_path, collection([item(0, **spans)]), "b.vpc")).tiles[0]
    assert (tile.start, tile.end) == ("2020-01-01", "2020-03-01")


def test_the_tiles_own_coordinates_come_before_degrees(tmp_path):
    change = pyproj.Transformer.from_crs(2154, 4326, always_xy=True)
    box = [900_000, 6_200_000, 0, 901_000, 6_201_000, 90]
    properties = {"proj:code": "EPSG:2154", "proj:bbox": box}
    tile = read_catalogue(written(tmp_path, collection([item(0, **properties)]))).tiles[0]
    x, y = np.meshgrid(np.linspace(900_000, 901_000, 9), np.linspace(6_200_000, 6_201_000, 9))
    lon, lat = change.transform(x, y)
    assert np.allclose(tile.outline.bounds, [lon.min(), lat.min(), lon.max(), lat.max()], atol=1e-7)
    assert pyproj.CRS(tile.crs).to_epsg() == 2154


@pytest.mark.parametrize("value", [True, -5, 1.5, "overview", {"overview": 1}, None, 10**30])
def test_roles_and_counts_that_are_none_are_passed_over(tmp_path, value):
    one = item(0, **{"pc:count": value})
    del one["assets"]["overview"]
    one["assets"]["data"]["roles"] = value
    (tile,) = read_catalogue(written(tmp_path, collection([one]))).tiles
    assert tile.points is None


@pytest.mark.parametrize("href", ["a\nb.laz", "a\x1b[31m.laz", "a;b.laz", "https://x/a\u2028.laz"])
def test_names_that_no_sheet_can_have_are_refused(href):
    for catalogue in (DISK, WEB):
        with pytest.raises(InputError, match="no sheet can have") as refused:
            resolved(href, catalogue, frozenset({"x"}))
        assert href not in str(refused.value)


def test_a_box_across_the_antimeridian_covers_nothing_but_itself(tmp_path):
    """Its west is east of its east (RFC 7946, section 5.2)."""
    one = item(0) | {"geometry": None, "bbox": [179.99, -17.0, -179.99, -16.9]}
    tile = read_catalogue(written(tmp_path, collection([one]))).tiles[0]
    far, near = around(5.0, -16.96, 5.01, -16.95), around(179.992, -16.96, 179.993, -16.95)
    assert cover_of([tile], far).hole_m2 == pytest.approx(far.area_m2)
    assert cover_of([tile], near).taken == (0,) and cover_of([tile], near).hole_m2 == 0


def test_an_index_tells_its_column_of_locations(tmp_path):
    tiles = read_catalogue(written(tmp_path, index())).tiles
    assert [tile.href for tile in tiles] == [f"tiles/t{k}.laz" for k in range(3)]
    file = written(tmp_path, index(url="https://host/a.laz"))
    with pytest.raises(InputError, match=r"2 columns .* --column; there are file, url"):
        read_catalogue(file)
    dated = read_catalogue(file, column="url", dates=("day", "day")).tiles
    assert {(t.href, t.start) for t in dated} == {("https://host/a.laz", "2020-02-03")}
    with pytest.raises(InputError, match="has no column 'where'"):
        read_catalogue(file, column="where")


def test_an_index_in_another_system_is_brought_to_degrees(tmp_path):
    change = pyproj.Transformer.from_crs(4326, 32631, always_xy=True)
    made = index(1)
    made["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}}
    ring = [list(change.transform(*corner)) for corner in square(0)]
    made["features"][0]["geometry"]["coordinates"] = [ring]
    tile = read_catalogue(written(tmp_path, made)).tiles[0]
    assert np.allclose(tile.outline.bounds, [WEST, SOUTH, WEST + SIDE, SOUTH + SIDE], atol=2e-6)


def geopackage(file, rings, srs=4326, layer="my tiles"):
    """A GeoPackage of one layer: polygons, and several polygons in one."""
    outlines = [shapely.Polygon(ring) for ring in rings]
    outlines = [shapely.multipolygons([one]) if k % 2 else one for k, one in enumerate(outlines)]
    columns = {"name": [f"T{k}" for k in range(len(rings))],
               "location": [f"t{k}.laz" for k in range(len(rings))]}  # fmt: skip
    table = geopandas.GeoDataFrame(columns, geometry=outlines, crs=srs)
    table.to_file(file, layer=layer, driver="GPKG")
    return str(file)


@pytest.mark.parametrize("srs", [4326, 2154])
def test_a_geopackage_is_read(tmp_path, srs):
    change = pyproj.Transformer.from_crs(4326, srs, always_xy=True)
    rings = [[change.transform(*corner) for corner in square(k)] for k in range(2)]
    tiles = read_catalogue(geopackage(tmp_path / "a.gpkg", rings, srs)).tiles
    assert [tile.href for tile in tiles] == ["t0.laz", "t1.laz"]
    for k, tile in enumerate(tiles):
        box = [WEST + k * SIDE, SOUTH, WEST + (k + 1) * SIDE, SOUTH + SIDE]
        assert np.allclose(tile.outline.bounds, box, atol=2e-6)


def polygon(ring):
    return {"geometry": {"type": "Polygon", "coordinates": [ring]}}


DAMAGED = {
    "nothing": b"",
    "no JSON": b"{]",
    "no text": b"\xff\xfe\0",
    "deep": b"[" * 100_000,
    "a list": b"[]",
    "SQLite cut": b"SQLite format 3\0" + bytes(80),
    "a collection": {"type": "Collection", "links": []},
    "no feature": collection([7]),
    "no features": collection([]),
    "features of another kind": collection({"a": 1}),
    "another page": collection([item(0)]) | {"links": [{"rel": "next", "href": "x"}]},
    "more matched": collection([item(0)]) | {"numberMatched": 12},
    "no outline": {"geometry": None},
    "off the Earth": polygon([[900, 9]] * 4),
    "beyond all numbers": polygon([[10**400, 1]] * 4),
    "not a number": polygon([["a", 1]] * 4),
    "a box beyond all numbers": {"geometry": None, "bbox": [10**400, 1, 2, 3]},
    "a box of three": {"geometry": None, "bbox": [1, 2, 3]},
    "no data": {"assets": {}},
    "assets of another kind": {"assets": [1]},
    "properties of another kind": {"properties": 3, "assets": {"d": {"href": "a.zip"}}},
    "two files": {"assets": {"a": {"href": "a.laz"}, "b": {"href": "b.laz"}}},
}


@pytest.mark.parametrize("fault", DAMAGED)
def test_a_damaged_catalogue_is_refused(tmp_path, fault):
    content, file = DAMAGED[fault], tmp_path / "tiles.json"
    if isinstance(content, dict):  # of a file, or of an item
        whole = content if "type" in content else collection([item(0) | content])
        content = json.dumps(whole).encode()
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"tiles\.json") as error:
        read_catalogue(str(file))
    assert error.value.remedy


@pytest.mark.parametrize("far", [float("inf"), float("nan"), 1e308])
@pytest.mark.filterwarnings("error")
def test_own_coordinates_without_end_leave_those_in_degrees(tmp_path, far):
    one = item(0, **{"proj:code": "EPSG:2154", "proj:bbox": [-far, -far, far, far]})
    (tile,) = read_catalogue(written(tmp_path, collection([one]))).tiles
    assert tile.outline.bounds == (WEST, SOUTH, WEST + SIDE, SOUTH + SIDE)


def test_damaged_geopackages_are_refused_or_read_right(tmp_path):
    """Bytes are changed at random: what comes is an InputError or tiles, and nothing else."""
    whole = bytearray(
        (tmp_path / "a.gpkg").read_bytes()
        if geopackage(tmp_path / "a.gpkg", [square(k) for k in range(6)])
        else b""
    )
    rng = np.random.default_rng(3)
    refused = 0
    for k in range(60):
        content = bytearray(whole)
        for at in rng.integers(100, len(content), 30):
            content[at] ^= 1 << int(rng.integers(8))
        file = tmp_path / f"{k}.gpkg"
        file.write_bytes(content[: rng.integers(len(content))] if k % 3 == 0 else content)
        try:
            read_catalogue(str(file))
        except InputError:
            refused += 1
    assert refused > 10


def test_a_catalogue_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    file = written(tmp_path, collection([item(0)]))
    monkeypatch.setattr("stereotruth.lidar.catalogue.MOST_BYTES", 10)
    with pytest.raises(InputError, match="larger than"):
        read_catalogue(file)


WEB, DISK = "https://data.example.org/lidar/index.json", "lidar/tiles.vpc"
HOSTS = frozenset({"tiles.example.org"})  # that the user allows
B = "https://tiles.example.org/b.laz"


@pytest.mark.parametrize(
    ("catalogue", "href", "hosts", "where"),
    [
        (WEB, "a.laz", HOSTS, "https://data.example.org/lidar/a.laz"),
        (WEB, "../other/a.laz", HOSTS, "https://data.example.org/other/a.laz"),
        (WEB, "/a.laz", HOSTS, "https://data.example.org/a.laz"),
        (WEB, "https://data.example.org/b.laz", HOSTS, "https://data.example.org/b.laz"),
        (WEB, B, HOSTS, B),
        (DISK, B, HOSTS, B),
        (DISK, "./a.laz", frozenset(), "lidar/a.laz"),
        (DISK, "/data/a.laz", frozenset(), "/data/a.laz"),
        ("s3://bucket/x/i.json", "sub/a.laz", frozenset(), "s3://bucket/x/sub/a.laz"),
        *((WEB, href, HOSTS, "") for href in (
            "file:///etc/passwd", "FILE:///etc/passwd", "https://evil.example/a.laz",
            "//evil.example/a.laz", "https://data.example.org.evil.example/a.laz",
            "https://data.example.org@evil.example/a.laz", "https://data.example.org:8443/a.laz",
            "http://tiles.example.org/a.laz",  # came by https itself
            "http://data.example.org/a.laz", "s3://data/a.laz", "ftp://data.example.org/a.laz",
            "ftp://tiles.example.org/a.laz",  # an allowed host, by another scheme
            "file://tiles.example.org/etc/a.laz", "gopher://x/", "data:text/plain,x",
            "https://[::1/a.laz", "http://169.254.169.254/latest/meta-data",
        )),
        *((DISK, href, frozenset(), "") for href in (
            "file:///etc/passwd", "https://evil.example/a.laz", "//evil.example/a", "s3://b/a.laz",
        )),
        ("s3://bucket/x/i.json", "s3://other/a.laz", frozenset(), ""),
    ],
)  # fmt: skip
def test_a_catalogue_leads_to_its_own_origin_and_to_allowed_hosts(catalogue, href, hosts, where):
    if where:
        assert resolved(href, catalogue, hosts) == where
        return
    with pytest.raises(InputError, match="a tile of it leads to"):
        resolved(href, catalogue, hosts)


def around(west, south, east, north):
    """A footprint of the cells that a box touches."""
    outline = np.array([[west, east, east, west], [south, south, north, north]])
    return Footprint.around([outline], 0.0)


def tile(ring, href="a.laz"):
    return Tile(href, shapely.Polygon(ring))


def test_the_tiles_that_touch_the_footprint_are_taken():
    tiles = [tile(square(k, row)) for row in range(4) for k in range(4)]
    footprint = around(WEST + 0.5 * SIDE, SOUTH + 0.5 * SIDE, WEST + 1.5 * SIDE, SOUTH + 0.6 * SIDE)
    cover = cover_of(tiles, footprint)
    assert cover.taken == (0, 1)
    assert cover.hole_m2 == 0 and cover.hole_at is None and not cover.doubled


def test_a_slanting_outline_is_taken_only_where_it_is():
    corners = [[0, 0], [10, 10], [9.8, 10.2], [-0.2, 0.2]]  # a narrow strip
    strip = tile([[WEST + x * SIDE, SOUTH + y * SIDE] for x, y in corners])
    on = around(WEST + 5 * SIDE, SOUTH + 5 * SIDE, WEST + 5.01 * SIDE, SOUTH + 5.01 * SIDE)
    off = around(WEST + 8 * SIDE, SOUTH + 2 * SIDE, WEST + 8.1 * SIDE, SOUTH + 2.1 * SIDE)
    assert cover_of([strip], on).taken == (0,)
    assert cover_of([strip], off).taken == ()


def test_taken_tiles_are_all_that_share_a_place_with_the_footprint():
    """Against places strewn over random triangles: whatever has one in the footprint is taken."""
    rng = np.random.default_rng(5)
    footprint = around(WEST, SOUTH, WEST + 2 * SIDE, SOUTH + 2 * SIDE)
    for _ in range(200):
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
    metres = 111_195 * SIDE
    wanted = metres**2 * np.cos(np.radians(SOUTH + 1.5 * SIDE))
    assert abs(cover.hole_m2 / wanted - 1) < 0.02
    assert WEST + SIDE < cover.hole_at[0] < WEST + 2 * SIDE
    assert SOUTH + SIDE < cover.hole_at[1] < SOUTH + 2 * SIDE


def test_a_hole_in_an_outline_is_a_hole():
    outer, inner = square(0, 0, 3 * SIDE), square(1, 1)
    footprint = around(WEST + SIDE / 2, SOUTH + SIDE / 2, WEST + 2.5 * SIDE, SOUTH + 2.5 * SIDE)
    assert cover_of([Tile("a.laz", shapely.Polygon(outer, [inner]))], footprint).hole_m2 > 0
    assert cover_of([tile(outer)], footprint).hole_m2 == 0


def test_doubled_tiles_are_named():
    tiles = [tile(square(0)), tile(square(1)), tile(square(1), "again.laz"), tile(square(2))]
    footprint = around(WEST, SOUTH, WEST + 3 * SIDE, SOUTH + SIDE)
    assert cover_of(tiles, footprint).doubled == ((1, 2),)


def made_list(**more):
    tiles = (
        ListedTile("lidar/a.laz", 10, "", 5, "2020-01-01", "2020-01-02"),
        ListedTile("https://host/b.copc.laz", 11, '"tag"', -1, "", ""),
    )
    values = {
        "catalogue": "lidar/tiles.vpc",
        "sha256": "0" * 64,
        "bytes": 3,
        "hosts": ("x.example", "y.example"),
        "ground": ((40950, 4761, 4763), (40951, 4762, 4762)),
        "footprint_m2": 4e6,
        "hole_m2": 5e5,
        "crs": "EPSG:2154+5720",
        "tiles": tiles,
    }
    return TileList(**(values | more))


def test_a_list_is_read_as_it_was_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_list(made_list(), "lidar/a.tsv")
    assert read_list("lidar/a.tsv") == made_list()
    wkt = pyproj.CRS("EPSG:2154").to_wkt(pretty=True)
    write_list(made_list(crs=wkt), "lidar/b.tsv")
    assert pyproj.CRS(read_list("lidar/b.tsv").crs) == pyproj.CRS(2154)
    assert "0.5 km² (12 %) of the 4 km²" in read_list("lidar/a.tsv").hole_text


def test_the_files_of_a_list_are_known_without_a_network(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(remote_files, "ask_patiently", None)  # nobody is asked
    write_list(made_list(), "a.tsv")
    local, stand_in = files_of_list("a.tsv")
    assert local == "lidar/a.laz"
    assert url_of(stand_in) == "https://host/b.copc.laz"
    assert hosts_of(stand_in) == {"x.example", "y.example"}
    before = (tmp_path / stand_in).stat().st_mtime_ns
    files_of_list("a.tsv")
    assert (tmp_path / stand_in).stat().st_mtime_ns == before


@pytest.mark.parametrize(
    "damage",
    [*(lambda text, cut=cut: text[:cut] for cut in (0, 40, 200, 400, -30)),
     lambda text: "".join(text.splitlines(keepends=True)[:-1]),
     lambda text: text.replace("2020-01-02", "spring 2020"),
     lambda text: text.replace("\t10\t", "\tten\t"),
     lambda text: text.replace("# hosts", "# guests")],
)  # fmt: skip
def test_a_damaged_list_is_refused(tmp_path, damage):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    file.write_text(damage(file.read_text()))
    with pytest.raises(InputError, match=r"a\.tsv") as error:
        read_list(file)
    assert error.value.remedy


def test_a_catalogue_that_has_changed_is_told(tmp_path):
    catalogue = tmp_path / "tiles.vpc"
    catalogue.write_text("{}")
    write_list(made_list(catalogue=str(catalogue), hole_m2=0.0), tmp_path / "a.tsv")
    assert ["has changed since" in remark for remark in remarks_on(tmp_path / "a.tsv")] == [True]


def test_ground_that_a_list_was_not_asked_for_is_told(tmp_path):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    asked = Footprint.of_runs(made_list().ground)
    assert unlisted_m2([file], asked) == 0
    wider = Footprint.of_runs([*asked.runs, [40952, 4762, 4763]])
    assert abs(unlisted_m2([file], wider) / (wider.area_m2 - asked.area_m2) - 1) < 1e-6


def test_cells_that_name_lists_and_catalogues():
    assert is_list("lidar/a.tsv") and not is_list("https://host/a.tsv") and not is_list("a.laz")
    for name in (
        "a.vpc",
        "https://host/a.json",
        "https://host/a.json?sig=x",
        "a.GPKG",
        "x/a.geojson",
    ):
        assert is_catalogue(name)
    for name in ("https://host/x/ept.json", "ept.json", "https://host/a.laz?of=a.json", "a.tsv"):
        assert not is_catalogue(name)
