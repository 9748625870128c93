"""Queries of point stores."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
import zarr

from stereotruth.errors import InputError
from stereotruth.lidar import lattice
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore, open_stores, query_points

from ...synthetic.las import everything, write_las

# ------------------------------------------------------------------ queries


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> PointStore:
    folder = tmp_path_factory.mktemp("points")
    write_las(folder / "a.laz", 30_000)
    ingest(folder / "a.laz", folder / "a.zarr")
    return PointStore(folder / "a.zarr")


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
        ingest(tmp_path / f"{name}.laz", tmp_path / f"{name}.zarr")
    whole = PointStore(tmp_path / "all.zarr")
    lon_min, lat_min, lon_max, lat_max = whole.bounds[:4]
    box = (lon_min, lat_min, (lon_min + lon_max) / 2, (lat_min + lat_max) / 2)
    expected = whole.query(*box)
    for names in ("ab", "ba"):
        got = query_points([tmp_path / f"{name}.zarr" for name in names], *box)
        assert len(got) == len(expected) > 500
        for name in ("lon_q", "lat_q", "h_q"):
            assert np.array_equal(np.sort(getattr(got, name)), np.sort(getattr(expected, name)))
    parts = [PointStore(tmp_path / f"{name}.zarr") for name in "ab"]
    assert sum(part.attrs["points"]["kept"] for part in parts) == 4000
    bounds = np.array([part.bounds for part in parts])
    outermost = (f(bounds[:, k]) for k, f in enumerate([np.min] * 2 + [np.max] * 2))
    assert (*outermost, bounds[:, 4].min(), bounds[:, 5].max()) == whole.bounds
    boxes = boxes_of(whole)
    assert np.array_equal(boxes_of(*parts), boxes)
    width = (boxes[:, 2] - boxes[:, 0]) * np.cos(np.radians(boxes[:, 1]))
    covered_m2 = (width * (boxes[:, 3] - boxes[:, 1])).sum() * lattice.DEGREE_M**2
    assert covered_m2 == pytest.approx(0.49e6, abs=0.2e6)  # whole cells
    inside = (expected.lon[:, None] >= boxes[:, 0]) & (expected.lon[:, None] < boxes[:, 2])
    inside &= (expected.lat[:, None] >= boxes[:, 1]) & (expected.lat[:, None] < boxes[:, 3])
    assert (inside.sum(axis=1) == 1).all()


def test_only_finished_point_stores_open(tmp_path) -> None:
    with pytest.raises(InputError, match="no such"):
        PointStore(tmp_path / "none.zarr")
    write_las(tmp_path / "a.laz")
    ingest(tmp_path / "a.laz", tmp_path / "a.zarr")
    zarr.open_group(tmp_path / "a.zarr").attrs["complete"] = False
    group = zarr.open_group(tmp_path / "other.zarr", mode="w")
    group.attrs["complete"] = True
    with pytest.raises(InputError, match="no point store"):
        PointStore(tmp_path / "other.zarr")


def test_files_of_a_scene_share_one_way_to_wgs84(tmp_path) -> None:
    """Projections may differ, what is done about the datum not."""
    spain = pyproj.Transformer.from_crs(4326, 23030, always_xy=True)
    for name, place in (("spain", (-2.7, 40.3)), ("sea", (-2.7, 53.3)), ("other", (-2.6, 40.4))):
        xyz = np.array([*spain.transform(*place), 60]) + np.random.default_rng(0).uniform(
            0, 300, (200, 3)
        )
        write_las(tmp_path / f"{name}.las", xyz=xyz, system=pyproj.CRS("EPSG:23030"))
        ingest(tmp_path / f"{name}.las", tmp_path / f"{name}.zarr")
    write_las(tmp_path / "utm.las", 200)
    ingest(tmp_path / "utm.las", tmp_path / "utm.zarr")
    paths = [tmp_path / f"{name}.zarr" for name in ("spain", "other", "utm", "sea")]
    assert [store.path for store in open_stores(paths[:3])] == paths[:3]
    with pytest.raises(InputError, match=r"sea.zarr: .*ED50 to WGS 84.*spain.zarr.*Remedy"):
        open_stores(paths)
