"""Surface models as LiDAR: cells against the points that they must become.

What values, units and systems of rasters mean is held by test_doors.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products import rasters
from stereotruth.lidar import height_raster
from stereotruth.lidar.ingest import ingest, survey
from stereotruth.lidar.point_store import PointStore

from ...synthetic.copc_server import serving
from ...synthetic.las import SOUTH, WEST, everything, refused, write_gtx
from ...synthetic.stores import tree_digest
from ...synthetic.surface_rasters import UTM, write_raster


def surface(rows: int = 90, cols: int = 70) -> np.ndarray:
    rng = np.random.default_rng(0)
    heights = rng.permutation(np.linspace(20, 60, rows * cols, dtype=np.float32))
    heights = heights.reshape(rows, cols)  # of which each tells its cell
    heights[rng.random((rows, cols)) < 0.2] = -9999
    heights[3, 4] = np.nan
    return heights


@pytest.mark.parametrize("profile", [{}, {"tiled": True, "blockxsize": 16, "blockysize": 32}])
def test_cells_become_points_in_their_middles(tmp_path, monkeypatch, profile):
    heights = surface()
    file = write_raster(tmp_path / "a.tif", heights, **profile)
    surveyed, found = survey(file), ingest(file, tmp_path / "a.points")
    got = everything(PointStore(tmp_path / "a.points"))
    row, col = np.nonzero(heights > -1000)
    to_degrees = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    lon, lat = to_degrees.transform(WEST + (col + 0.5) * 0.5, SOUTH + 100 - (row + 0.5) * 0.5)
    truth = np.column_stack([lon, lat, heights[row, col].astype(float)])
    assert found["points"]["kept"] == len(truth) == found["points"]["read"]
    got_points = np.column_stack([got.lon, got.lat, got.height])[np.argsort(got.h_q)]
    truth = truth[np.argsort(truth[:, 2])]
    np.testing.assert_allclose(got_points[:, :2], truth[:, :2], rtol=0, atol=2.1e-9)
    np.testing.assert_allclose(got_points[:, 2], truth[:, 2], rtol=0, atol=1.1e-4)
    assert set(got.classification) == set(got.return_number) == set(got.number_of_returns) == {1}
    assert any("surface model of cells of 0.5" in note for note in found["notes"])
    # and are surveyed without being read
    np.testing.assert_allclose(surveyed.box, found["bounds"][:4], atol=1e-5)
    assert surveyed.heights[0] == pytest.approx(20, abs=1) and surveyed.heights[1] <= 60
    assert list(surveyed.notes) == found["notes"]
    # whatever is read at once
    monkeypatch.setattr(rasters, "MOST_CELLS", 1)
    ingest(file, tmp_path / "b.points")
    assert tree_digest(tmp_path / "b.points") == tree_digest(tmp_path / "a.points")


def test_lidar_crs_says_what_the_heights_of_a_raster_count_from(tmp_path):
    compound = write_raster(tmp_path / "a.tif", surface(), crs="EPSG:32650+5773")
    grid = write_gtx(tmp_path / "egm96.gtx", np.full((5, 5), 10.0), 116, 29, 0.5)
    found = ingest(compound, tmp_path / "a.points", geoid=grid)
    plain = write_raster(tmp_path / "b.tif", surface())
    by_sheet = ingest(plain, tmp_path / "b.points", geoid=grid, lidar_crs="EPSG:32650+5773")
    assert by_sheet["bounds"] == found["bounds"]
    assert by_sheet["bounds"][5] == pytest.approx(70, abs=0.1)


def test_rasters_that_are_no_surface_models_are_refused(tmp_path):
    good, file = surface(), tmp_path / "a.tif"
    refused(tmp_path / "none.tif", "no such LiDAR file")
    refused(write_raster(file, good, crs=None), "no coordinate reference system")
    empty = write_raster(file, np.full((9, 9), -9999, np.float32))
    assert survey(empty).heights is None
    refused(empty, "no point is left of 0")
    refused(write_raster(file, good, cell=90.0), "surface model of cells of 90 m")
    write_raster(file, good)
    file.write_bytes(file.read_bytes()[:3000])
    refused(file, "GeoTIFF that can be read")


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A surface model on a server: the server, its stand-in, its file on the disk."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    heights = rng.uniform(20, 60, (300, 400)).astype(np.float32)
    tiled = {"tiled": True, "blockxsize": 128, "blockysize": 128, "compress": "deflate"}
    file = write_raster(tmp_path / "tile.tif", heights, 1.0, **tiled)
    monkeypatch.setattr(height_raster, "STREAM_BYTES", 1 << 15)
    with serving(file.read_bytes()) as server:
        server.url = server.url.replace("tile.copc.laz", "tile.tif")
        yield server, server.stand_in(), file


def test_a_raster_of_a_server_is_that_of_the_disk_and_asked_for_once(served):
    server, place, file = served
    ingest(place, "web.points")
    ingest(file, "disk.points")
    assert tree_digest(Path("web.points")) == tree_digest(Path("disk.points"))
    spans = [text.rpartition("=")[2] for text in server.requests]
    assert len(spans) == len(set(spans)) > 5
    assert server.sent < 1.4 * file.stat().st_size
    server.requests.clear()
    ingest(place, "again.points")
    with ThreadPoolExecutor(8) as pool:  # several at once
        found = list(pool.map(survey, [place] * 16))
    assert server.requests == []
    assert {(one.heights, one.read) for one in found} == {(survey(file).heights, survey(file).read)}


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("redirect to another host", "another host, other.invalid"),
        ("replaced: ETag", "changed on its server"),
        ("gone", "no such file there"),
    ],
)
@pytest.mark.parametrize("when", [2, 4])
def test_a_raster_of_a_server_is_whole_or_refused(served, fault, words, when):
    """GDAL asks through this package: it is led nowhere else, whatever comes first."""
    server, place, _ = served
    server.fault, server.when = fault, when
    with pytest.raises(InputError, match=words) as refused:
        ingest(place, "web.points")
    assert "secret" not in str(refused.value)
    assert not Path("web.points").exists()
