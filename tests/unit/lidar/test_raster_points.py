"""Surface models as rasters: cells against the points that they must become."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyproj
import pytest
from rasterio.transform import Affine

from stereotruth.core.errors import InputError
from stereotruth.core.products import raster_values
from stereotruth.lidar import height_raster as raster_points
from stereotruth.lidar.ingest import ingest, survey
from stereotruth.lidar.point_store import PointStore

from ...synthetic.copc_server import serving
from ...synthetic.las import FT, SOUTH, US_FT, WEST, everything, refused, write_gtx
from ...synthetic.stores import tree_digest
from ...synthetic.surface_rasters import UTM, write_raster


def surface(rows: int = 90, cols: int = 70) -> np.ndarray:
    rng = np.random.default_rng(0)
    heights = rng.permutation(np.linspace(20, 60, rows * cols, dtype=np.float32))
    heights = heights.reshape(rows, cols)  # of which each tells its cell
    heights[rng.random((rows, cols)) < 0.2] = -9999
    heights[3, 4] = np.nan
    return heights


def expected(heights: np.ndarray, cell: float = 0.5) -> np.ndarray:
    """Longitude, latitude, height [n, 3] of the middles of the cells that have a height."""
    row, col = np.nonzero(heights > -1000)
    truth = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    lon, lat = truth.transform(WEST + (col + 0.5) * cell, SOUTH + 100 - (row + 0.5) * cell)
    return np.column_stack([lon, lat, heights[row, col].astype(float)])


@pytest.mark.parametrize(
    "profile",
    [{}, {"tiled": True, "blockxsize": 16, "blockysize": 32}, {"compress": "deflate"}],
)
def test_cells_become_points_in_their_middles(tmp_path, profile):
    heights = surface()
    file = write_raster(tmp_path / "a.tif", heights, **profile)
    found = ingest(file, tmp_path / "a.points")
    got = everything(PointStore(tmp_path / "a.points"))
    truth = expected(heights)
    assert found["points"]["kept"] == len(truth) == found["points"]["read"]
    got_points = np.column_stack([got.lon, got.lat, got.height])[np.argsort(got.h_q)]
    truth = truth[np.argsort(truth[:, 2])]
    np.testing.assert_allclose(got_points[:, :2], truth[:, :2], rtol=0, atol=2.1e-9)
    np.testing.assert_allclose(got_points[:, 2], truth[:, 2], rtol=0, atol=1.1e-4)
    assert set(got.classification) == set(got.return_number) == set(got.number_of_returns) == {1}
    assert any("surface model of cells of 0.5" in note for note in found["notes"])


def test_the_store_does_not_depend_on_what_is_read_at_once(tmp_path, monkeypatch):
    file = write_raster(tmp_path / "a.tif", surface())
    digests = set()
    for cells in (1, 1000, 1 << 20):
        monkeypatch.setattr(raster_values, "MOST_CELLS", cells)
        ingest(file, tmp_path / "a.points")
        digests.add(tree_digest(tmp_path / "a.points"))
    assert len(digests) == 1


def test_scale_offset_and_integers(tmp_path):
    raw = np.array([[100, 200], [-32768, 300]], np.int16)
    write_raster(tmp_path / "a.tif", raw, nodata=-32768, scales=(0.1, 5.0))
    ingest(tmp_path / "a.tif", tmp_path / "a.points")
    assert sorted(everything(PointStore(tmp_path / "a.points")).height) == [15.0, 25.0, 35.0]


@pytest.mark.parametrize(
    ("units", "metres"), [("", 1.0), ("metre", 1.0), ("ft", FT), ("US survey foot", US_FT)]
)
def test_the_unit_of_the_band_counts(tmp_path, units, metres):
    write_raster(tmp_path / "a.tif", np.full((2, 2), 100, np.float32), units=units)
    ingest(tmp_path / "a.tif", tmp_path / "a.points")
    height = everything(PointStore(tmp_path / "a.points")).height
    np.testing.assert_allclose(height, 100 * metres, atol=2e-4)


def test_a_compound_system_asks_for_its_geoid(tmp_path):
    file = write_raster(tmp_path / "a.tif", surface(), crs="EPSG:32650+5773")
    refused(file, r"heights are orthometric \('EGM96 height'\)")
    grid = write_gtx(tmp_path / "egm96.gtx", np.full((5, 5), 10.0), 116, 29, 0.5)
    found = ingest(file, tmp_path / "a.points", geoid=grid)
    assert found["crs"]["heights"].startswith("orthometric (EGM96 height)")
    plain = write_raster(tmp_path / "b.tif", surface())
    by_sheet = ingest(plain, tmp_path / "b.points", geoid=grid, lidar_crs="EPSG:32650+5773")
    assert by_sheet["bounds"] == found["bounds"]
    assert by_sheet["bounds"][5] == pytest.approx(70, abs=0.1)


def test_rasters_that_are_no_surface_models_are_refused(tmp_path):
    good, file = surface(), tmp_path / "a.tif"
    colours = np.zeros((3, 9, 9), np.uint8)
    refused(write_raster(file, colours, count=3, nodata=None), "3 bands of uint8")
    refused(write_raster(file, good, crs=None), "no coordinate reference system")
    turned = Affine(0.5, 0.1, WEST, 0.1, -0.5, SOUTH)
    refused(write_raster(file, good, transform=turned), "north up")
    refused(write_raster(file, good, nodata=None), r"of -9999, which is no height.*no nodata value")
    refused(write_raster(file, good, nodata=0), "which is no height.*declares nodata 0")
    refused(write_raster(file, np.full((9, 9), -9999, np.float32)), "no point is left of 0")
    refused(write_raster(file, good, cell=90.0), "surface model of cells of 90 m")
    refused(write_raster(file, good, units="fathom"), "'fathom', which is no known unit")
    write_raster(file, good)
    file.write_bytes(file.read_bytes()[:3000])
    refused(file, "GeoTIFF that can be read")


def test_a_raster_is_surveyed_without_its_cells(tmp_path):
    file = write_raster(tmp_path / "a.tif", surface())
    found, read = survey(file), ingest(file, tmp_path / "a.points")
    np.testing.assert_allclose(found.box, read["bounds"][:4], atol=1e-5)
    assert found.heights[0] == pytest.approx(20, abs=1) and found.heights[1] <= 60
    assert list(found.notes) == read["notes"]
    empty = write_raster(tmp_path / "b.tif", np.full((9, 9), -9999, np.float32))
    assert survey(empty).heights is None
    with pytest.raises(InputError, match="no such LiDAR file"):
        survey(tmp_path / "none.tif")


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A surface model on a server: the server, its stand-in, its file on the disk."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    heights = rng.uniform(20, 60, (300, 400)).astype(np.float32)
    tiled = {"tiled": True, "blockxsize": 128, "blockysize": 128, "compress": "deflate"}
    file = write_raster(tmp_path / "tile.tif", heights, 1.0, **tiled)
    monkeypatch.setattr(raster_points, "STREAM_BYTES", 1 << 15)
    with serving(file.read_bytes()) as server:
        server.url = server.url.replace("tile.copc.laz", "tile.tif")
        yield server, server.stand_in(), file


def test_a_raster_of_a_server_is_that_of_the_disk_and_asked_for_once(served):
    server, place, file = served
    ingest(place, "web.points")
    ingest(file, "disk.points")
    assert tree_digest(Path("web.points")) == tree_digest(Path("disk.points"))
    assert survey(place).read == survey(file).read
    spans = [text.rpartition("=")[2] for text in server.requests]
    assert len(spans) == len(set(spans)) > 5
    assert server.sent < 1.4 * file.stat().st_size
    server.requests.clear()
    ingest(place, "again.points")
    assert server.requests == []


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("redirect to another host", "another host, other.invalid"),
        ("redirect to file:", "no file of a web server"),
        ("replaced: ETag", "changed on its server"),
        ("no ranges", "as a whole only"),
        ("gone", "no such file there"),
    ],
)
@pytest.mark.parametrize("when", [0, 2, 4])
def test_a_raster_of_a_server_is_whole_or_refused(served, fault, words, when):
    """GDAL asks through this package: it is led nowhere else, whatever comes first."""
    server, place, _ = served
    server.fault, server.when = fault, when
    if fault.startswith("replaced") and not when:
        return
    with pytest.raises(InputError, match=words) as refused:
        ingest(place, "web.points")
    assert "secret" not in str(refused.value)
    assert not Path("web.points").exists()


def test_rasters_of_servers_are_surveyed_by_several_at_once(served):
    _, place, file = served
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(survey, [place] * 16))
    assert {one.heights for one in found} == {survey(file).heights}
