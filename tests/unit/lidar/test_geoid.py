"""Geoid grids against PROJ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin

from stereotruth.core.errors import InputError
from stereotruth.lidar import geoid

from ...synthetic.las import write_gtx


def undulations(west: float, south: float, step: float, shape: tuple[int, int]) -> np.ndarray:
    lat = south + step * np.arange(shape[0])[:, None]
    lon = west + step * np.arange(shape[1])
    return 20 + 8 * np.sin(np.radians(7 * lon)) * np.cos(np.radians(5 * lat))


# ------------------------------------------------------------------ geoid grids


@pytest.mark.parametrize("west", [-124.0, 236.0])
def test_geoid_is_bilinear_as_in_proj(tmp_path, west) -> None:
    """Against PROJ's own vgridshift; grids from −180 and from 0 (VDatum writes both)."""
    values = undulations(west, 43.0, 0.05, (41, 61))
    grid = write_gtx(tmp_path / "g.gtx", values, west, 43.0, 0.05)
    rng = np.random.default_rng(1)
    lon, lat = rng.uniform(-124, -121, 5000), rng.uniform(43, 45, 5000)
    lon[:4], lat[:4] = [-124, -121, -124, -121], [43, 43, 45, 45]  # the outermost nodes
    ours = geoid.GeoidGrid(grid)(lon, lat)
    proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=vgridshift +grids={grid} +multiplier=1 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    _, _, theirs = proj.transform(lon[4:], lat[4:], np.zeros(4996))
    np.testing.assert_allclose(ours[4:], theirs, rtol=0, atol=2e-6)
    corners = values[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(ours[:4], corners, rtol=0, atol=2e-6)


def test_global_geoid_has_no_seam(tmp_path) -> None:
    step = 0.5
    values = 30 * np.sin(np.radians(np.arange(720) * step)) * np.ones((361, 1))
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "g.gtx", values, 0.0, -90.0, step))
    lon = np.array([-0.25, 0.25, 359.75, 180.0, -180.0, 179.75, -179.75])
    expected = 30 * np.sin(np.radians(lon))
    np.testing.assert_allclose(grid(lon, np.zeros(7)), expected, atol=2e-3)  # chord of 0.5°
    assert np.isfinite(grid(np.array([10.0, 10.0]), np.array([-90.0, 90.0]))).all()


def test_geoid_reads_more_rows_as_chunks_ask(tmp_path) -> None:
    values = undulations(0.0, 40.0, 0.1, (101, 51))
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "g.gtx", values, 0.0, 40.0, 0.1))
    lon, lat = np.full(200, 1.23), np.linspace(40, 50, 200)
    order = np.random.default_rng(0).permutation(200)
    one_by_one = np.array([grid(lon[k : k + 1], lat[k : k + 1])[0] for k in order])
    at_once = geoid.GeoidGrid(grid.path)(lon, lat)
    np.testing.assert_array_equal(one_by_one, at_once[order])


@pytest.mark.parametrize("problem", ["outside", "nodata"])
def test_points_without_undulation_are_refused(tmp_path, problem) -> None:
    values = undulations(10.0, 40.0, 0.1, (11, 11))
    if problem == "nodata":
        values[5, 5] = np.nan
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "small.gtx", values, 10.0, 40.0, 0.1))
    lon = np.array([10.1, 10.51 if problem == "nodata" else 11.2])
    with pytest.raises(InputError, match=r"small\.gtx.* 1 points|1 points .*small\.gtx"):
        grid(lon, np.array([40.1, 40.51]))


def geotiff(path: Path, values: np.ndarray, system: str, scale: float = 1.0) -> Path:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=values.shape[1],
        height=values.shape[0],
        count=1,
        dtype="int16" if scale != 1 else "float32",
        crs=system,
        transform=from_origin(9.95, 41.05, 0.1, 0.1),  # nodes from 10.0, 41.0
        nodata=-9999,
    ) as grid:
        grid.write((values / scale).astype(grid.dtypes[0]), 1)
        grid.scales = (scale,)
    return path


def test_geotiff_grid_with_scale(tmp_path) -> None:
    values = np.round(undulations(10.0, 40.0, 0.1, (11, 11))[::-1], 2)
    plain = geoid.GeoidGrid(geotiff(tmp_path / "a.tif", values, "EPSG:4326"))
    scaled = geoid.GeoidGrid(geotiff(tmp_path / "b.tif", values, "EPSG:4326", scale=0.01))
    lon, lat = np.array([10.0, 10.33, 11.0]), np.array([41.0, 40.77, 40.0])
    np.testing.assert_allclose(plain(lon[[0, 2]], lat[[0, 2]]), [values[0, 0], values[-1, -1]])
    np.testing.assert_allclose(plain(lon, lat), scaled(lon, lat), atol=0.011)


@pytest.mark.parametrize(
    ("system", "reason"), [("EPSG:32632", "longitude and latitude"), ("EPSG:4314", "Bessel")]
)
def test_grids_of_other_kinds_are_refused(tmp_path, system, reason) -> None:
    grid = geotiff(tmp_path / "a.tif", np.zeros((11, 11)), system)
    with pytest.raises(InputError, match=reason):
        geoid.GeoidGrid(grid)


def test_missing_or_broken_grid_is_named(tmp_path) -> None:
    with pytest.raises(InputError, match=r"none\.gtx"):
        geoid.GeoidGrid(tmp_path / "none.gtx")
    (tmp_path / "bad.gtx").write_bytes(b"not a grid")
    with pytest.raises(InputError, match=r"bad\.gtx"):
        geoid.GeoidGrid(tmp_path / "bad.gtx")
