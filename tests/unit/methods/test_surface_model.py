"""Disparities to surface models: intersections and rasters against scenes known exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from stereobench.methods import surface_model
from stereobench.methods.surface_model import (
    Raster,
    gsd,
    raster_of,
    write_dsm,
)
from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import Layer, atomic_store, create_grid
from stereotruth.epipolar.model import EpipolarModel

from ...synthetic.cameras import HEIGHT
from ...synthetic.flat_model import EPSG, SIZE, disparity_of, make_model, metres, plane
from ...synthetic.other_programs import PROGRAMS
from ...synthetic.stores import Killed


@pytest.fixture(scope="module")
def model() -> EpipolarModel:
    return make_model()


@pytest.fixture(scope="module")
def of_plane(model) -> np.ndarray:
    return disparity_of(model, plane)


def write_grid(path: Path, model: EpipolarModel | None, disparity: np.ndarray) -> Path:
    layer = Layer("float32", np.nan, {"units": "px", "long_name": "disparity"})
    attrs = {"epipolar": model and model.to_dict(), "content": str(float(np.nansum(disparity)))}
    with atomic_store(path) as scratch:
        grids = {"disparity": layer}
        arrays = create_grid(scratch, disparity.shape, grids, chunk=64, shard=128, attrs=attrs)
        arrays["disparity"][:] = disparity
    return path


def read(path: Path) -> tuple[np.ndarray, Raster, dict]:
    with rasterio.open(path) as dataset:
        values = dataset.read(1)
        values[values == dataset.nodata] = np.nan
        t = dataset.transform
        raster = Raster(dataset.crs.to_epsg(), t.c, t.f, t.a, dataset.shape)
        return values, raster, dataset.tags() | {"profile": dataset.profile}


def test_the_model_of_a_plane_is_the_plane(model, of_plane, tmp_path):
    store = write_grid(tmp_path / "d.zarr", model, of_plane)
    assert gsd(model.left, SIZE, HEIGHT) == pytest.approx(0.65, rel=2e-3)
    assert raster_of(model, (HEIGHT, HEIGHT + 10), None).resolution == 0.8  # the coarser pixel
    summary = write_dsm(store, tmp_path / "dsm.tif", resolution_m=0.7)
    found, raster, tags = read(tmp_path / "dsm.tif")
    assert raster.epsg == EPSG == summary["epsg"]
    assert raster.resolution == 0.7
    assert raster.west / 0.7 == pytest.approx(round(raster.west / 0.7), abs=1e-6)
    row, col = np.mgrid[: raster.shape[0], : raster.shape[1]]
    lon, lat = raster.ground(col.astype(float), row.astype(float))
    wanted = plane(lon, lat)
    known = np.isfinite(found)
    assert np.abs(found - wanted)[known].max() < 2e-3
    # every cell whose centre the left grid shows has its height: no gaps
    x, y = model.ground_to_epipolar(lon, lat, wanted)[:2].reshape(2, *wanted.shape)
    shown = (x >= 0) & (y >= 0) & (x <= model.shape[1] - 1) & (y <= model.shape[0] - 1)
    near = 0.01
    inner = (x > near) & (y > near) & (x < model.shape[1] - 1 - near)
    inner &= y < model.shape[0] - 1 - near
    assert known[inner].all()
    assert not known[~shown & ((x < -near) | (y < -near))].any()
    assert tags["vertical_datum"] == "WGS 84 ellipsoid"
    assert tags["profile"]["nodata"] == -9999.0
    for by_program in PROGRAMS.values():
        values = by_program(tmp_path / "dsm.tif")
        assert np.array_equal(np.where(values == -9999, np.nan, values), found, equal_nan=True)


@pytest.mark.slow
def test_a_block_of_buildings_has_its_roofs_and_open_edges(model, tmp_path):
    """A flat roof of 40 m: heights of roof and ground right, nothing in between."""

    def town(lon, lat):
        east, north = metres(lon, lat)
        return np.where((np.abs(east) < 30) & (np.abs(north) < 20), HEIGHT + 40.0, HEIGHT)

    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(float)
    lon, lat = model.epipolar_to_ground(x, y, HEIGHT + 40.0)  # the roof hides what is behind it
    on_roof = town(lon, lat) > HEIGHT
    d = np.where(
        on_roof,
        disparity_of(model, lambda lon, lat: np.full(np.shape(lon), HEIGHT + 40.0)),
        disparity_of(model, lambda lon, lat: np.full(np.shape(lon), HEIGHT)),
    )
    store = write_grid(tmp_path / "d.zarr", model, d)
    write_dsm(store, tmp_path / "dsm.tif", resolution_m=0.5)
    found, raster, _ = read(tmp_path / "dsm.tif")
    known = np.isfinite(found)
    roof, ground = (np.abs(found - h) < 0.01 for h in (HEIGHT + 40.0, HEIGHT))
    assert (roof | ground)[known].all()
    row, col = np.mgrid[: raster.shape[0], : raster.shape[1]].astype(float)
    east, north = metres(*raster.ground(col, row))
    inside = (np.abs(east) < 29) & (np.abs(north) < 19)
    assert roof[inside].all()
    assert not roof[(np.abs(east) > 30.1) | (np.abs(north) > 20.1)].any()


def test_of_two_surfaces_over_a_cell_the_higher_one_counts():
    out = np.full((6, 6), np.nan, np.float32)
    surface_model._triangle((0.0, 0.0, 5.0), (5.0, 0.0, 5.0), (0.0, 5.0, 5.0), out)
    surface_model._triangle((0.0, 0.0, 9.0), (2.0, 0.0, 9.0), (0.0, 2.0, 9.0), out)
    surface_model._triangle((0.0, 0.0, 1.0), (5.0, 0.0, 1.0), (0.0, 5.0, 1.0), out)
    wanted = np.full((6, 6), np.nan)
    row, col = np.mgrid[:6, :6]
    wanted[row + col <= 5] = 5.0
    wanted[row + col <= 2] = 9.0
    assert np.array_equal(out, wanted, equal_nan=True)


def test_blocks_and_kills_leave_no_trace(model, of_plane, tmp_path, monkeypatch):
    store = write_grid(tmp_path / "d.zarr", model, of_plane)
    monkeypatch.setattr(surface_model, "SHARD", 256)
    write_dsm(store, tmp_path / "fresh.tif", workers=2)
    out, made, block = tmp_path / "dsm.tif", [], surface_model.SurfaceModel.block

    def counted(self, store, key, rows, cols):
        if len(made) == 2:
            raise Killed
        block(self, store, key, rows, cols)
        made.append((rows.start, cols.start))

    with monkeypatch.context() as patch:
        patch.setattr(surface_model.SurfaceModel, "block", counted)
        with pytest.raises(Killed):
            write_dsm(store, out, scheduler="synchronous")
    assert not out.exists()
    before = made[:]
    made = ["from here on"]  # two of them would be a kill
    monkeypatch.setattr(
        surface_model.SurfaceModel, "block", lambda *a: (block(*a), made.append(a[3].start))
    )
    write_dsm(store, out, scheduler="synchronous")
    assert len(before) == 2
    assert out.read_bytes() == (tmp_path / "fresh.tif").read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"d.zarr", "fresh.tif", "dsm.tif"}


def test_grids_that_say_too_little_are_refused(model, tmp_path):
    nothing = np.full((20, 20), np.nan, np.float32)
    with pytest.raises(InputError, match=r"a\.zarr"):
        write_dsm(write_grid(tmp_path / "a.zarr", None, nothing), tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"b\.zarr"):
        write_dsm(write_grid(tmp_path / "b.zarr", model, nothing), tmp_path / "b.tif")
