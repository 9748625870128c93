"""Queries of point stores."""

from __future__ import annotations

import json
import shutil
import zlib

import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import sealed
from stereotruth.lidar import point_store
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
    parts = [store.points_of(cell) for cell in range(store.cell_row.size)]
    assert [len(part) for part in parts] == store.cell_counts.tolist()
    assert np.array_equal(np.concatenate([part.h_q for part in parts]), got.h_q)
    assert np.array_equal(store.square_counts.sum(axis=(1, 2)), store.cell_counts)


def test_only_whole_point_stores_of_this_format_open(store, tmp_path) -> None:
    with pytest.raises(InputError):
        PointStore(tmp_path / "none.points")
    attrs = json.loads((store.path / ATTRIBUTES).read_text())
    for number, other in enumerate(({"kind": "grid"}, {"format": 0}, {"source": "b.laz"})):
        shutil.copytree(store.path, tmp_path / str(number))
        file = tmp_path / str(number) / ATTRIBUTES
        sealed_anew = number < 2  # of another kind or format; else edited
        values = {k: v for k, v in attrs.items() if k != "digest"} | other
        file.write_text(sealed(values) if sealed_anew else json.dumps(attrs | other))
        with pytest.raises(InputError):
            PointStore(tmp_path / str(number))


def test_edges_between_lattice_points(store) -> None:
    lon, lat = (value[123] for value in (everything(store).lon, everything(store).lat))
    assert len(store.query(lon, lat, lon, lat)) == 1
    assert len(store.query(np.nextafter(lon, 180), lat, lon + 4e-10, lat)) == 0
    assert len(store.query(-np.inf, -np.inf, np.inf, np.inf)) == store.count
    west, south, east, north = store.bounds[:4]
    assert len(store.query(west, north + 1e-8, east, north + 1)) == 0
    assert len(store.query(east, north, west, south)) == 0
    assert store.height_range(10, 10, 11, 11) is None and len(query_points([], 0, 0, 1, 1)) == 0


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
        for at in [0, first, size - 1, *rng.integers(first, size, 12)]:
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
        with pytest.raises(InputError):
            PointStore(folder)


@pytest.mark.parametrize("piece", [7, 1000])
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
