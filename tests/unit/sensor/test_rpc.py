"""RPC models against GDAL and shareloc; corrections by line: their inverse and their words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import RPCTransformer

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.rpc import RPC, LineCorrection, SensorModel, localize_point, project_point
from stereotruth.sensor.rpc_files import read_rpc

from ...synthetic.cameras import HEIGHT, LAT, LON, ground_points, make_rpc, to_rasterio
from ...synthetic.images import write_image
from ...synthetic.real_data import MARSEILLE
from ...synthetic.textured_pair import SIZE, TRUE

AFFINE = np.array([[1.0001, 2e-4, -3.5], [-1e-4, 0.9998, 4.25]])


def rpcs() -> list:
    cases = [pytest.param(make_rpc(s, o), id=f"random-{s}") for s, o in ((1, 0), (3, -36))]
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
    expected = AFFINE @ np.stack([*model.rpc.project(lon, lat, height), np.ones(37)])
    assert np.allclose((col, row), expected, atol=1e-8)
    singles = [project_point(model.packed(), *point) for point in zip(lon, lat, height)]
    assert np.array_equal(np.transpose(singles), (col, row))
    back = model.localize(col, row, height)
    assert localize_point(model.packed(), col[3], row[3], height[3]) == (back[0][3], back[1][3])
    assert model.packed().shape == (96,) and model.rpc.packed().shape == (90,)


def test_longitude_is_cyclic() -> None:
    rpc = RPC.from_dict(make_rpc(6).to_dict() | {"long_off": 179.99})
    a = rpc.project(-179.98, rpc.lat_off, 100.0)
    b = rpc.project(180.02, rpc.lat_off, 100.0)
    assert np.allclose(a, b, atol=1e-6)


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


# ------------------------------------------------------------------ corrections by line


def swinging(seed: int, px: float = 0.3) -> LineCorrection:
    """Coefficients of ``px`` each: lines jump more from one to the next than any attitude does."""
    values = np.random.default_rng(seed).normal(0, px, (2, 23))
    return LineCorrection((0.0, SIZE[1] - 1.0), values)


def jittering() -> tuple[SensorModel, SensorModel]:
    return tuple(SensorModel(s.rpc, s.affine, swinging(k)) for k, s in enumerate(TRUE))


def places(count: int = 200) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(3)
    lon, lat = LON + rng.uniform(-1e-3, 1e-3, count), LAT + rng.uniform(-1e-3, 1e-3, count)
    return lon, lat, HEIGHT + rng.uniform(-20, 20, count)


def test_what_is_added_is_taken_off_again_in_and_beside_the_image():
    lines = swinging(1)
    row = np.concatenate([np.linspace(-50, SIZE[1] + 50, 701), [np.nan]])
    col = np.full_like(row, 12.0)
    back = lines.take(*lines.add(col, row))
    assert np.allclose(back[0][:-1], 12.0, atol=1e-8)
    assert np.allclose(back[1][:-1], row[:-1], atol=1e-8)
    assert np.isnan(back[1][-1])
    assert np.abs(np.subtract(lines.add(col, row), (col, row))[:, :-1]).max() > 0.1


def test_its_record_evaluates_by_its_own_words():
    values = json.loads(json.dumps(swinging(2).to_dict()))
    row = 101.25
    n = len(values["col"])
    s = (row - values["row_min"]) / (values["row_max"] - values["row_min"]) * (n - 3)
    i = min(int(np.floor(s)), n - 4)
    f = s - i
    weights = (
        (1 - f) ** 3 / 6,
        (3 * f**3 - 6 * f**2 + 4) / 6,
        (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6,
        f**3 / 6,
    )
    by_hand = [sum(w * values[k][i + a] for a, w in enumerate(weights)) for k in ("col", "row")]
    assert np.allclose(LineCorrection.from_dict(values).at(row), by_hand, atol=1e-12)


def test_a_sensor_projects_what_it_localises():
    sensor = jittering()[0]
    lon, lat, height = places()
    col, row = sensor.project(lon, lat, height)
    back = sensor.localize(col, row, height)
    assert np.abs(np.subtract(back, (lon, lat))).max() < 1e-12
    again = SensorModel.from_dict(json.loads(json.dumps(sensor.to_dict())))
    assert np.array_equal(again.project(lon, lat, height), (col, row))
    assert np.abs(np.subtract(sensor.smooth.project(lon, lat, height), (col, row))).max() > 0.1
    # an RPC that stands for it says what it lacks
    assert sensor.smooth.corrected_rpc()[1] < 1e-3 < 0.2 < sensor.corrected_rpc()[1]


def test_rows_of_images_that_jitter_are_equal(tmp_path):
    """What RPCs cannot follow leaves no y-parallax, and labels are where the images show them."""
    left, right = jittering()
    model = fit_epipolar(left, right, SIZE, SIZE, HEIGHT)
    model.save(tmp_path / "epipolar.json")
    model = EpipolarModel.load(tmp_path / "epipolar.json")
    ground = places()
    x_left, y_left = model.left_to_epipolar(*left.project(*ground))
    x_right, y_right = model.right_to_epipolar(*right.project(*ground))
    assert np.abs(y_left - y_right).max() < 0.01
    assert np.allclose(
        model.ground_to_epipolar(*ground), [x_left, y_left, x_right, y_right], atol=1e-6
    )
    assert np.allclose(model.epipolar_to_left(x_left, y_left), left.project(*ground), atol=1e-6)
    assert "by_line" in json.loads((tmp_path / "epipolar.json").read_text())["formula"]


@pytest.mark.parametrize("values", [np.zeros((2, 3)), np.full((2, 5), np.nan), np.zeros(8)])
def test_what_is_no_correction_is_refused(values):
    with pytest.raises(ValueError):
        LineCorrection((0.0, 10.0), values)
