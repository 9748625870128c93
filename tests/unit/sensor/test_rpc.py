"""RPC models against GDAL and shareloc, and the readers of each file format."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import RPCTransformer

from stereotruth.sensor.rpc import RPC, SensorModel, localize_point, project_point
from stereotruth.sensor.rpc_files import read_rpc

from ...synthetic.cameras import ground_points, make_rpc, to_rasterio
from ...synthetic.images import write_image
from ...synthetic.real_data import MARSEILLE

AFFINE = np.array([[1.0001, 2e-4, -3.5], [-1e-4, 0.9998, 4.25]])


def rpcs() -> list:
    cases = [pytest.param(make_rpc(s, o), id=f"random-{s}") for s, o in ((1, 0), (2, 0), (3, -36))]
    for side in ("left", "right"):
        image = MARSEILLE / f"{side}.tif"
        if image.is_file():
            cases.append(pytest.param(read_rpc(image), id=f"marseille-{side}"))
        else:
            mark = pytest.mark.skip(reason="the real scene of ../shared is not here")
            cases.append(pytest.param(None, id=f"marseille-{side}", marks=mark))
    return cases


@pytest.mark.parametrize("rpc", rpcs())
def test_projection_agrees_with_gdal(rpc: RPC) -> None:
    lon, lat, height = ground_points(rpc)
    col, row = rpc.project(lon, lat, height)
    with RPCTransformer(to_rasterio(rpc)) as transformer:
        gdal_row, gdal_col = transformer.rowcol(lon, lat, height, op=float)
    # GDAL counts from the corner of the upper-left pixel, RPC00B from its centre.
    assert np.abs(np.array(gdal_col) - 0.5 - col).max() < 1e-6
    assert np.abs(np.array(gdal_row) - 0.5 - row).max() < 1e-6


@pytest.mark.parametrize("rpc", rpcs())
def test_projection_and_localisation_agree_with_shareloc(rpc: RPC, tmp_path: Path) -> None:
    shareloc = pytest.importorskip("shareloc.geomodels")
    model = shareloc.GeoModel(str(write_image(tmp_path / "image.tif", rpc)), "RPC")
    lon, lat, height = ground_points(rpc)
    col, row = rpc.project(lon, lat, height)
    their_row, their_col, _ = model.inverse_loc(lon, lat, height)
    # shareloc has pixel centres at half integers
    assert np.abs(their_col - 0.5 - col).max() < 1e-6
    assert np.abs(their_row - 0.5 - row).max() < 1e-6
    theirs = model.direct_loc_inverse_iterative(row + 0.5, col + 0.5, height, nb_iter_max=50)
    difference = np.asarray(theirs)[:2] - rpc.localize(col, row, height)
    assert np.abs(difference).max() < 1e-9  # degrees


@pytest.mark.parametrize("rpc", rpcs())
def test_localisation_inverts_projection(rpc: RPC) -> None:
    lon, lat, height = ground_points(rpc)
    model = SensorModel(rpc, AFFINE)
    col, row = model.project(lon, lat, height)
    there = np.array(model.localize(col, row, height))
    assert np.abs(there - (lon, lat)).max() < 1e-12
    again = np.array(model.project(*there, height))
    assert np.abs(again - (col, row)).max() < 1e-6


def test_one_point_and_many_give_the_same_bits() -> None:
    model = SensorModel(make_rpc(4), AFFINE)
    lon, lat, height = ground_points(model.rpc, 37)
    col, row = model.project(lon, lat, height)
    singles = [project_point(model.packed(), *point) for point in zip(lon, lat, height)]
    assert np.array_equal(np.transpose(singles), (col, row))
    back = model.localize(col, row, height)
    assert localize_point(model.packed(), col[3], row[3], height[3]) == (back[0][3], back[1][3])
    assert model.packed().shape == (96,) and model.rpc.packed().shape == (90,)


def test_arrays_broadcast() -> None:
    rpc = make_rpc(5)
    col, row = rpc.project(np.full((3, 1), rpc.long_off), np.full(4, rpc.lat_off), 100.0)
    assert col.shape == row.shape == (3, 4)


def test_longitude_is_cyclic() -> None:
    rpc = RPC.from_dict(make_rpc(6).to_dict() | {"long_off": 179.99})
    a = rpc.project(-179.98, rpc.lat_off, 100.0)
    b = rpc.project(180.02, rpc.lat_off, 100.0)
    assert np.allclose(a, b, atol=1e-6)


def test_localisation_off_the_earth_is_nan() -> None:
    lon, lat = make_rpc(7).localize(np.nan, 10.0, 100.0)
    assert np.isnan(lon) and np.isnan(lat)


def test_affine_acts_on_image_coordinates() -> None:
    rpc = make_rpc(8)
    lon, lat, height = ground_points(rpc, 20)
    col, row = rpc.project(lon, lat, height)
    expected = AFFINE @ np.vstack([col, row, np.ones(20)])
    assert np.allclose(SensorModel(rpc, AFFINE).project(lon, lat, height), expected, atol=1e-8)


@pytest.mark.parametrize("rpc", rpcs())
def test_corrected_rpc_stands_for_rpc_and_affine(rpc: RPC) -> None:
    model = SensorModel(rpc, AFFINE)
    corrected, error = model.corrected_rpc()
    lon, lat, height = ground_points(rpc)
    difference = np.subtract(corrected.project(lon, lat, height), model.project(lon, lat, height))
    # The shear mixes two denominators, which one RPC cannot hold exactly.
    assert np.abs(difference).max() < 1.5 * error + 1e-6
    assert error < 5e-3
    shifted, error = SensorModel(rpc, [[1, 0, 2.5], [0, 1, -3.5]]).corrected_rpc()
    assert error < 1e-6
    assert shifted.samp_off == rpc.samp_off + 2.5


def test_models_survive_json() -> None:
    model = SensorModel(make_rpc(9), AFFINE)
    again = SensorModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert np.array_equal(again.packed(), model.packed())
