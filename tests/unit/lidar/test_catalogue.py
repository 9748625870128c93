"""Catalogues of tiles: read in each form, believed in nothing that leads elsewhere."""

from __future__ import annotations

import json
import sqlite3
import struct

import numpy as np
import pyproj
import pytest

from stereotruth.errors import InputError
from stereotruth.lidar.catalogue import read_catalogue, resolved
from stereotruth.lidar.catalogue_ground import cover_of
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
from stereotruth.lidar.catalogue_tiles import Tile
from stereotruth.lidar.footprint import CELL_DEG, Footprint
from stereotruth.products import remote_files
from stereotruth.products.remote_files import hosts_of, url_of

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
    assert np.allclose(tiles[1].box, [WEST + SIDE, SOUTH, WEST + 2 * SIDE, SOUTH + SIDE])


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
    assert np.allclose(tile.box, [lon.min(), lat.min(), lon.max(), lat.max()], atol=1e-7)
    assert pyproj.CRS(tile.crs).to_epsg() == 2154


@pytest.mark.parametrize("roles", [True, 7, 1.5, "overview", {"overview": 1}, None])
def test_roles_that_are_none_hide_no_tile(tmp_path, roles):
    one = item(0)
    del one["assets"]["overview"]
    one["assets"]["data"]["roles"] = roles
    assert len(read_catalogue(written(tmp_path, collection([one]))).tiles) == 1


@pytest.mark.parametrize("count", [True, -5, 1.5, "9", None, 10**30])
def test_a_count_of_points_that_is_none_is_not_known(tmp_path, count):
    one = item(0, **{"pc:count": count})
    assert read_catalogue(written(tmp_path, collection([one]))).tiles[0].points is None


@pytest.mark.parametrize("href", ["a\nb.laz", "a\x1b[31m.laz", "a;b.laz", "https://x/a\u2028.laz"])
def test_names_that_no_sheet_can_have_are_refused(href):
    for catalogue in ("lidar/tiles.vpc", WEB):
        with pytest.raises(InputError, match="no sheet can have") as refused:
            resolved(href, catalogue, frozenset({"x"}))
        assert href not in str(refused.value)


def test_a_box_across_the_antimeridian_covers_nothing_but_itself(tmp_path):
    """Its west is east of its east (RFC 7946, section 5.2)."""
    one = item(0) | {"geometry": None, "bbox": [179.99, -17.0, -179.99, -16.9]}
    tile = read_catalogue(written(tmp_path, collection([one]))).tiles[0]
    assert len(tile.rings) == 2
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
    assert np.allclose(tile.box, [WEST, SOUTH, WEST + SIDE, SOUTH + SIDE], atol=2e-6)


def geopackage(file, rings, srs=4326, hrefs=None):
    """A GeoPackage of one layer of polygons, by hand."""
    base = sqlite3.connect(file)
    base.executescript(
        "CREATE TABLE gpkg_geometry_columns (table_name, column_name, kind, srs_id, z, m);"
        "CREATE TABLE gpkg_spatial_ref_sys (srs_name, srs_id, organization, "
        "organization_coordsys_id, definition);"
        'CREATE TABLE "my ""tiles" (fid INTEGER PRIMARY KEY, geom BLOB, name TEXT, location TEXT);'
    )
    base.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'POLYGON', ?, 0, 0)",
        ('my "tiles', srs),
    )
    base.execute("INSERT INTO gpkg_spatial_ref_sys VALUES ('x', ?, 'EPSG', ?, '')", (srs, srs))
    for k, ring in enumerate(rings):
        flat = np.array(ring, "<f8")
        wkb = struct.pack("<BIII", 1, 3, 1, len(flat)) + flat.tobytes()
        if k % 2:  # as several polygons, and with an envelope
            box = [*flat.min(axis=0), *flat.max(axis=0)]
            envelope = struct.pack("<4d", box[0], box[2], box[1], box[3])
            head = b"GP\0\3" + struct.pack("<i", srs) + envelope
            blob = head + struct.pack("<BII", 1, 6, 1) + wkb
        else:
            blob = b"GP\0\1" + struct.pack("<i", srs) + wkb
        href = hrefs[k] if hrefs else f"t{k}.laz"
        base.execute('INSERT INTO "my ""tiles" VALUES (NULL, ?, ?, ?)', (blob, f"T{k}", href))
    base.commit()
    base.close()
    return str(file)


def test_a_geopackage_is_read(tmp_path):
    file = geopackage(tmp_path / "a.gpkg", [square(0), square(1)])
    tiles = read_catalogue(file).tiles
    assert [tile.href for tile in tiles] == ["t0.laz", "t1.laz"]
    for k, tile in enumerate(tiles):
        assert np.allclose(tile.box[0], WEST + k * SIDE)


def test_a_geopackage_in_metres_is_brought_to_degrees(tmp_path):
    change = pyproj.Transformer.from_crs(4326, 2154, always_xy=True)
    ring = [change.transform(*corner) for corner in square(0)]
    tile = read_catalogue(geopackage(tmp_path / "a.gpkg", [ring], 2154)).tiles[0]
    assert np.allclose(tile.box, [WEST, SOUTH, WEST + SIDE, SOUTH + SIDE], atol=2e-6)


DAMAGED = {
    "nothing": b"",
    "no JSON": b"{]",
    "no text": b"\xff\xfe\0",
    "deep": b"[" * 100_000,
    "a list": b"[]",
    "a collection": b'{"type": "Collection", "links": []}',
    "no feature": b'{"type": "FeatureCollection", "features": [7]}',
    "no features": b'{"type": "FeatureCollection", "features": []}',
    "features of another kind": b'{"type": "FeatureCollection", "features": {"a": 1}}',
    "SQLite cut": b"SQLite format 3\0" + bytes(80),
    "another page": json.dumps(
        collection([item(0)]) | {"links": [{"rel": "next", "href": "x"}]}
    ).encode(),
    "more matched": json.dumps(collection([item(0)]) | {"numberMatched": 12}).encode(),
    "no outline": json.dumps(collection([item(0) | {"geometry": None}])).encode(),
    "off the Earth": json.dumps(
        collection([item(0) | {"geometry": {"type": "Polygon", "coordinates": [[[900, 9]] * 4]}}])
    ).encode(),
    "no data": json.dumps(collection([item(0) | {"assets": {}}])).encode(),
    "assets of another kind": json.dumps(collection([item(0) | {"assets": [1]}])).encode(),
    "properties of another kind": json.dumps(
        collection([item(0) | {"properties": 3, "assets": {"d": {"href": "a.zip"}}}])
    ).encode(),
    "beyond all numbers": json.dumps(
        collection(
            [item(0) | {"geometry": {"type": "Polygon", "coordinates": [[[10**400, 1]] * 4]}}]
        )
    ).encode(),
    "a box beyond all numbers": json.dumps(
        collection([item(0) | {"geometry": None, "bbox": [10**400, 1, 2, 3]}])
    ).encode(),
    "two files": json.dumps(
        collection([item(0) | {"assets": {"a": {"href": "a.laz"}, "b": {"href": "b.laz"}}}])
    ).encode(),
    "not a number": json.dumps(
        collection([item(0) | {"geometry": {"type": "Polygon", "coordinates": [[["a", 1]] * 4]}}])
    ).encode(),
}


@pytest.mark.parametrize("far", [float("inf"), float("nan"), 1e308])
@pytest.mark.filterwarnings("error")
def test_own_coordinates_without_end_leave_those_in_degrees(tmp_path, far):
    one = item(0, **{"proj:code": "EPSG:2154", "proj:bbox": [-far, -far, far, far]})
    (tile,) = read_catalogue(written(tmp_path, collection([one]))).tiles
    assert tile.box == (WEST, SOUTH, WEST + SIDE, SOUTH + SIDE)


@pytest.mark.parametrize("fault", DAMAGED)
def test_a_damaged_catalogue_is_refused(tmp_path, fault):
    file = tmp_path / "tiles.json"
    file.write_bytes(DAMAGED[fault])
    with pytest.raises(InputError, match=r"tiles\.json"):
        read_catalogue(str(file))


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


WEB = "https://data.example.org/lidar/index.json"


@pytest.mark.parametrize(
    ("href", "where"),
    [
        ("a.laz", "https://data.example.org/lidar/a.laz"),
        ("../other/a.laz", "https://data.example.org/other/a.laz"),
        ("/a.laz", "https://data.example.org/a.laz"),
        ("https://data.example.org/b.laz", "https://data.example.org/b.laz"),
        ("https://tiles.example.org/b.laz", "https://tiles.example.org/b.laz"),
    ],
)
def test_tiles_of_a_web_catalogue(href, where):
    assert resolved(href, WEB, frozenset({"tiles.example.org"})) == where


@pytest.mark.parametrize(
    "href",
    [
        "file:///etc/passwd",
        "FILE:///etc/passwd",
        "https://evil.example/a.laz",
        "//evil.example/a.laz",
        "https://data.example.org.evil.example/a.laz",
        "https://data.example.org@evil.example/a.laz",
        "https://data.example.org:8443/a.laz",
        "http://tiles.example.org/a.laz",  # came by https itself
        "http://data.example.org/a.laz",
        "s3://data/a.laz",
        "ftp://data.example.org/a.laz",
        "ftp://tiles.example.org/a.laz",  # an allowed host, by another scheme
        "file://tiles.example.org/etc/a.laz",
        "gopher://x/",
        "data:text/plain,x",
        "https://[::1/a.laz",
        "http://169.254.169.254/latest/meta-data",
    ],
)
def test_a_web_catalogue_leads_nowhere_else(href):
    with pytest.raises(InputError, match="a tile of it leads to"):
        resolved(href, WEB, frozenset({"tiles.example.org"}))


@pytest.mark.parametrize(
    "href", ["file:///etc/passwd", "https://evil.example/a.laz", "//evil.example/a", "s3://b/a.laz"]
)
def test_a_local_catalogue_leads_to_no_host_that_is_not_allowed(href):
    with pytest.raises(InputError, match="a tile of it leads to"):
        resolved(href, "lidar/tiles.vpc", frozenset())


def test_tiles_of_local_and_bucket_catalogues():
    assert resolved("./a.laz", "lidar/tiles.vpc", frozenset()) == "lidar/a.laz"
    assert resolved("/data/a.laz", "lidar/tiles.vpc", frozenset()) == "/data/a.laz"
    hosts = frozenset({"tiles.example.org"})
    there = "https://tiles.example.org/a.laz"
    assert resolved(there, "lidar/tiles.vpc", hosts) == there
    assert resolved("sub/a.laz", "s3://bucket/x/i.json", frozenset()) == "s3://bucket/x/sub/a.laz"
    with pytest.raises(InputError, match="another host"):
        resolved("s3://other/a.laz", "s3://bucket/x/i.json", frozenset())


def around(west, south, east, north):
    """A footprint of the cells that a box touches."""
    outline = np.array([[west, east, east, west], [south, south, north, north]])
    return Footprint.around([outline], 0.0)


def tile(ring, href="a.laz"):
    return Tile(href, (np.array(ring, np.float64).T,))


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
    ring = [np.array(r, np.float64).T for r in (outer, inner)]
    footprint = around(WEST + SIDE / 2, SOUTH + SIDE / 2, WEST + 2.5 * SIDE, SOUTH + 2.5 * SIDE)
    assert cover_of([Tile("a.laz", tuple(ring))], footprint).hole_m2 > 0
    assert cover_of([Tile("a.laz", (ring[0],))], footprint).hole_m2 == 0


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


def test_a_list_without_its_last_line_is_refused(tmp_path):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(InputError, match="1 of its 2 tiles stand in it"):
        read_list(file)


@pytest.mark.parametrize("cut", [0, 40, 200, 400, -1, -30])
def test_a_damaged_list_is_refused_or_whole(tmp_path, cut):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    text = file.read_text()
    file.write_text(text[:cut])
    if cut == -1:  # the last line's end
        assert read_list(file) == made_list()
    else:
        with pytest.raises(InputError, match="no list of tiles"):
            read_list(file)


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


def test_a_list_with_a_day_that_is_none_is_refused(tmp_path):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    file.write_text(file.read_text().replace("2020-01-02", "spring 2020"))
    with pytest.raises(InputError, match=r"no list of tiles that can be read .*spring 2020"):
        read_list(file)
