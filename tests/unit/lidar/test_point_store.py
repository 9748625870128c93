"""Queries of point stores."""

from __future__ import annotations

import json
import shutil
import zlib

import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.lidar import lattice, point_store
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import (
    ATTRIBUTES,
    CELLS,
    POINTS,
    Points,
    PointStore,
    open_stores,
    query_points,
)

from ...synthetic.las import SOUTH, WEST, everything, write_las

# ------------------------------------------------------------------ queries


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> PointStore:
    folder = tmp_path_factory.mktemp("points")
    write_las(folder / "a.laz", 30_000)
    ingest(folder / "a.laz", folder / "a.points")
    return PointStore(folder / "a.points")


def test_query_is_exact_inclusive_and_in_stored_order(store) -> None:
    got = everything(store)
    rng = np.random.default_rng(2)
    for _ in range(30):
        corners = rng.integers(0, len(got), 2)  # boxes whose edges pass through points
        lon_min, lon_max = np.sort(got.lon[corners])
        lat_min, lat_max = np.sort(got.lat[corners])
        inside = (got.lon >= lon_min) & (got.lon <= lon_max)
        inside &= (got.lat >= lat_min) & (got.lat <= lat_max)
        part = store.query(lon_min, lat_min, lon_max, lat_max)
        for name in ("lon_q", "lat_q", "h_q", "classification", "return_number"):
            assert np.array_equal(getattr(part, name), getattr(got, name)[inside])
        lowest, highest = store.height_range(lon_min, lat_min, lon_max, lat_max)
        assert lowest <= part.height.min() <= part.height.max() <= highest


def test_edges_between_lattice_points(store) -> None:
    lon, lat = (value[123] for value in (everything(store).lon, everything(store).lat))
    assert len(store.query(lon, lat, lon, lat)) == 1
    assert len(store.query(np.nextafter(lon, 180), lat, lon + 4e-10, lat)) == 0
    assert len(store.query(-np.inf, -np.inf, np.inf, np.inf)) == store.count


def test_empty_queries(store) -> None:
    lon_min, lat_min, lon_max, lat_max = store.bounds[:4]
    for box in [
        (lon_max + 1, lat_min, lon_max + 2, lat_max),
        (lon_min, lat_max + 1e-8, lon_max, lat_max + 1),
        (lon_max, lat_max, lon_min, lat_min),
    ]:
        got = store.query(*box)
        assert len(got) == len(got.lon) == 0
        assert got.h_q.dtype == np.int64
    assert store.height_range(10, 10, 11, 11) is None
    assert len(query_points([], 0, 0, 1, 1)) == 0


def boxes_of(*stores: PointStore) -> np.ndarray:
    """(lon_min, lat_min, lon_max, lat_max) of the cells that hold points, each once."""
    cells = [np.stack([store.cell_row, store.cell_col], axis=1) for store in stores]
    size = (1 << lattice.CELL_BITS) / lattice.PER_DEG
    corner = np.unique(np.concatenate(cells), axis=0)[:, ::-1] * size
    return np.hstack([corner, corner + size])


def test_two_stores_hold_what_one_does(tmp_path) -> None:
    """Split a file in two: the same points, and the same exact sums in either order."""
    xyz = write_las(tmp_path / "all.laz", 4000)
    write_las(tmp_path / "a.laz", xyz=xyz[:1500])
    write_las(tmp_path / "b.laz", xyz=xyz[1500:])
    for name in ("all", "a", "b"):
        ingest(tmp_path / f"{name}.laz", tmp_path / f"{name}.points")
    whole = PointStore(tmp_path / "all.points")
    lon_min, lat_min, lon_max, lat_max = whole.bounds[:4]
    box = (lon_min, lat_min, (lon_min + lon_max) / 2, (lat_min + lat_max) / 2)
    expected = whole.query(*box)
    for names in ("ab", "ba"):
        got = query_points([tmp_path / f"{name}.points" for name in names], *box)
        assert len(got) == len(expected) > 500
        for name in ("lon_q", "lat_q", "h_q"):
            assert np.array_equal(np.sort(getattr(got, name)), np.sort(getattr(expected, name)))
    parts = [PointStore(tmp_path / f"{name}.points") for name in "ab"]
    assert sum(part.attrs["points"]["kept"] for part in parts) == 4000
    bounds = np.array([part.bounds for part in parts])
    outermost = (f(bounds[:, k]) for k, f in enumerate([np.min] * 2 + [np.max] * 2))
    assert (*outermost, bounds[:, 4].min(), bounds[:, 5].max()) == whole.bounds
    boxes = boxes_of(whole)
    assert np.array_equal(boxes_of(*parts), boxes)
    width = (boxes[:, 2] - boxes[:, 0]) * np.cos(np.radians(boxes[:, 1]))
    covered_m2 = (width * (boxes[:, 3] - boxes[:, 1])).sum() * DEGREE_M**2
    assert covered_m2 == pytest.approx(0.49e6, abs=0.2e6)  # whole cells
    inside = (expected.lon[:, None] >= boxes[:, 0]) & (expected.lon[:, None] < boxes[:, 2])
    inside &= (expected.lat[:, None] >= boxes[:, 1]) & (expected.lat[:, None] < boxes[:, 3])
    assert (inside.sum(axis=1) == 1).all()


def test_only_point_stores_open(tmp_path) -> None:
    with pytest.raises(InputError, match="no such"):
        PointStore(tmp_path / "none.points")
    write_las(tmp_path / "a.laz")
    ingest(tmp_path / "a.laz", tmp_path / "a.points")
    file = tmp_path / "a.points" / ATTRIBUTES
    attrs = json.loads(file.read_text())
    for other, match in (({"kind": "grid"}, "no point store"), ({"format": 0}, "of format 0")):
        file.write_text(json.dumps(attrs | other))
        with pytest.raises(InputError, match=match):
            PointStore(tmp_path / "a.points")


def test_arrays_are_what_the_module_says(tmp_path) -> None:
    """Read by NumPy and the table of the module alone, with all that fits into the bits."""
    xyz = np.array([[WEST, SOUTH, -430.0], [WEST + 300, SOUTH, 8848.0], [WEST, SOUTH + 300, 0.5]])
    told = {"classification": [255, 0, 128], "return_number": [15, 0, 8]}
    told |= {"number_of_returns": [15, 0, 9]}
    write_las(tmp_path / "a.las", xyz=xyz, **{k: np.array(v, np.uint8) for k, v in told.items()})
    ingest(tmp_path / "a.las", tmp_path / "a.points", drop_classes=())
    points, cells = (np.load(tmp_path / "a.points" / name) for name in (POINTS, CELLS))
    assert points.dtype == np.uint32 and points.shape == (3, 3)
    of = np.searchsorted(cells["first"], np.arange(3), "right") - 1
    lon = (cells["col"][of].astype(int) * 2**20 + (points[:, 0] & 0xFFFFF)) / 1e9
    lat = (cells["row"][of].astype(int) * 2**20 + (points[:, 1] & 0xFFFFF)) / 1e9
    to_utm = pyproj.Transformer.from_crs(4326, 32650, always_xy=True)
    found = np.column_stack([*to_utm.transform(lon, lat), points[:, 2].view(np.int32) / 1e4])
    order = [int(np.abs(xyz - place).sum(axis=1).argmin()) for place in found]
    assert sorted(order) == [0, 1, 2]
    np.testing.assert_allclose(found, xyz[order], atol=3e-4)  # two steps of 1e-9 degree
    fields = points[:, 0] >> 20 & 255, points[:, 0] >> 28, points[:, 1] >> 20
    for field, name in zip(fields, told):
        assert field.tolist() == [told[name][k] for k in order]
    for cell, first, end in zip(cells, cells["first"], [*cells["first"][1:], 3]):
        heights = points[first:end, 2].view(np.int32)
        assert (cell["lowest"], cell["highest"]) == (heights.min(), heights.max())
        assert cell["crc32"] == zlib.crc32(points[first:end].tobytes())


def test_every_damaged_byte_of_the_arrays_is_told(store, tmp_path) -> None:
    """Wherever it is, whatever piece it is read in; and files that are cut short or grow."""
    rng = np.random.default_rng(3)
    good = {name: (store.path / name).read_bytes() for name in (POINTS, CELLS, ATTRIBUTES)}
    for name in (POINTS, CELLS):
        size = len(good[name])
        first = size - np.load(store.path / name).nbytes
        spoilt = []
        for at in [0, first, size - 1, *rng.integers(first, size, 30)]:
            data = bytearray(good[name])
            data[at] ^= 1 << rng.integers(8)
            spoilt.append(bytes(data))
        spoilt += [good[name][:-1], good[name][: size // 2], b"", good[name] + b"\0"]
        for number, data in enumerate(spoilt):
            folder = tmp_path / f"{name}{number}"
            folder.mkdir()
            for other, text in good.items():
                (folder / other).write_bytes(data if other == name else text)
            with pytest.raises(InputError, match=rf"{name}: damaged.*Remedy: delete"):
                everything(PointStore(folder))
    for name in good:
        folder = tmp_path / f"without {name}"
        shutil.copytree(store.path, folder)
        (folder / name).unlink()
        with pytest.raises(InputError, match="Remedy"):
            PointStore(folder)
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / ATTRIBUTES).write_bytes(good[ATTRIBUTES][:-9])
    with pytest.raises(InputError, match=f"{ATTRIBUTES}: damaged"):
        PointStore(tmp_path / "text")


@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_pieces_leave_no_trace(store, monkeypatch, piece) -> None:
    """Cells that fit into a piece, that fill several, that end with one."""
    west, south, east, north = store.bounds[:4]
    box = (west, south, west + 0.3 * (east - west), south + 0.3 * (north - south))
    expected = store.query(*box)
    monkeypatch.setattr(point_store, "_PIECE", piece)
    found = store.query(*box)
    assert len(expected) > 1000
    for name in Points.__dataclass_fields__:
        assert np.array_equal(getattr(found, name), getattr(expected, name))


def test_a_query_reads_its_cells_only(store, monkeypatch) -> None:
    """A damaged cell does no harm to those that do not ask for it."""
    boxes = boxes_of(store)
    monkeypatch.setattr(store, "_crc32", [0, *store._crc32[1:]])
    far = boxes[-1] - [-1e-8, -1e-8, 1e-8, 1e-8]
    assert len(store.query(*far)) > 0
    with pytest.raises(InputError, match="damaged"):
        store.query(*boxes[0])


def test_files_of_a_scene_share_one_way_to_wgs84(tmp_path) -> None:
    """Projections may differ, what is done about the datum not."""
    spain = pyproj.Transformer.from_crs(4326, 23030, always_xy=True)
    for name, place in (("spain", (-2.7, 40.3)), ("sea", (-2.7, 53.3)), ("other", (-2.6, 40.4))):
        xyz = np.array([*spain.transform(*place), 60]) + np.random.default_rng(0).uniform(
            0, 300, (200, 3)
        )
        write_las(tmp_path / f"{name}.las", xyz=xyz, system=pyproj.CRS("EPSG:23030"))
        ingest(tmp_path / f"{name}.las", tmp_path / f"{name}.points")
    write_las(tmp_path / "utm.las", 200)
    ingest(tmp_path / "utm.las", tmp_path / "utm.points")
    paths = [tmp_path / f"{name}.points" for name in ("spain", "other", "utm", "sea")]
    assert [store.path for store in open_stores(paths[:3])] == paths[:3]
    with pytest.raises(InputError, match=r"sea.points: .*ED50 to WGS 84.*spain.points.*Remedy"):
        open_stores(paths)
