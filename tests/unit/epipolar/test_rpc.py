"""RPC models against GDAL and shareloc, and the readers of each file format."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.rpc import RPC as RasterioRPC
from rasterio.transform import RPCTransformer

from stereotruth.epipolar.rpc import RPC, SensorModel, localize_point, project_point
from stereotruth.epipolar.rpc_files import read_rpc
from stereotruth.errors import InputError

SHARED = Path(__file__).parents[3] / "shared"
MARSEILLE = SHARED / "real" / "marseille"
AFFINE = np.array([[1.0001, 2e-4, -3.5], [-1e-4, 0.9998, 4.25]])


def make_rpc(seed: int, image_offset: float = 0.0) -> RPC:
    """A random RPC of realistic size: 20 km, ±500 m, 2 px of cubic terms, image rotated at will.

    ``image_offset`` moves the image away from the RPC's centre, in units of the image scale.
    """
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    numerators = []
    for axis in range(2):
        numerator = rng.normal(0, [1e-3, *[1e-2] * 3, *[5e-4] * 6, *[1e-4] * 10])
        numerator[1:3] += turn[axis] * (1.0, -1.0)
        numerator[3] += rng.uniform(-0.05, 0.05)
        numerator[0] += image_offset
        numerators.append(numerator)
    denominators = rng.normal(0, 2e-4, (2, 20))
    denominators[:, 0] = 1.0
    return RPC(
        line_off=15000.25 - image_offset * 14000,
        samp_off=17000.5 - image_offset * 16000,
        lat_off=rng.uniform(-60, 60),
        long_off=rng.uniform(-170, 170),
        height_off=250.0,
        line_scale=14000.0,
        samp_scale=16000.0,
        lat_scale=0.09,
        long_scale=0.12,
        height_scale=500.0,
        line_num_coeff=numerators[1],
        line_den_coeff=denominators[1],
        samp_num_coeff=numerators[0],
        samp_den_coeff=denominators[0],
    )


def to_rasterio(rpc: RPC) -> RasterioRPC:
    return RasterioRPC(**rpc.to_dict(), err_bias=None, err_rand=None)


def write_image(path: Path, rpc: RPC | None, pixels: np.ndarray | None = None, **options) -> Path:
    pixels = np.full((8, 8), 7, dtype=np.uint16) if pixels is None else pixels
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=pixels.shape[1],
            height=pixels.shape[0],
            count=1,
            dtype=pixels.dtype,
            **options,
        ) as dataset:
            dataset.write(pixels, 1)
            if rpc is not None:
                dataset.rpcs = to_rasterio(rpc)
    return path


def ground_points(rpc: RPC, n: int = 500) -> np.ndarray:
    box = rpc.ground_box
    t = np.random.default_rng(1).random((3, n))
    low, high = np.array([box[0], box[1], box[4]]), np.array([box[2], box[3], box[5]])
    return low[:, None] + t * (high - low)[:, None]


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


# -------------------------------------------------------------------------------------- readers


def rpc_text(rpc: RPC) -> str:
    units = {"line": "pixels", "samp": "pixels", "lat": "degrees", "long": "degrees"}
    lines = []
    for name, value in rpc.to_dict().items():
        if isinstance(value, list):
            lines += [f"{name.upper()}_{i}: {v:+.15E}" for i, v in enumerate(value, start=1)]
        else:
            unit = units.get(name.split("_")[0], "meters")
            lines.append(f"{name.upper()}: {value:+017.10f} {unit}")
    return "\r\n".join(lines) + "\r\n"


def rpb_text(rpc: RPC, spec: str = "RPC00B") -> str:
    values = rpc.to_dict()
    lines = ['satId = "GF7";', 'bandId = "PAN";', f'SpecId = "{spec}";', "BEGIN_GROUP = IMAGE"]
    lines += ["\terrBias = 0.0;", "\terrRand = 0.0;"]
    for ours, theirs in (("line", "line"), ("samp", "samp"), ("lat", "lat"), ("long", "long")):
        lines.append(f"\t{theirs}Offset = {values[f'{ours}_off']!r};")
        lines.append(f"\t{theirs}Scale = {values[f'{ours}_scale']!r};")
    lines.append(f"\theightOffset = {values['height_off']!r};")
    lines.append(f"\theightScale = {values['height_scale']!r};")
    for name in ("line_num", "line_den", "samp_num", "samp_den"):
        kind, part = name.split("_")
        body = ",\n".join(f"\t\t\t{v:+.15E}" for v in values[f"{name}_coeff"])
        lines.append(f"\t{kind}{part.capitalize()}Coef = (\n{body});")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;", ""])


def assert_same(a: RPC, b: RPC) -> None:
    lon, lat, height = ground_points(b, 50)
    difference = np.subtract(a.project(lon, lat, height), b.project(lon, lat, height))
    assert np.abs(difference).max() < 1e-5  # offsets are written with ten decimals


@pytest.mark.parametrize(
    ("name", "writer"),
    [
        ("GF7_scene-BWD_RPC.TXT", rpc_text),
        ("GF7_scene-BWD_rpc.txt", rpc_text),
        ("GF7_scene-BWD.RPB", rpb_text),
        ("GF7_scene-BWD.rpb", rpb_text),
    ],
)
def test_files_beside_the_image(tmp_path: Path, name: str, writer) -> None:
    rpc = make_rpc(10)
    image = write_image(tmp_path / "GF7_scene-BWD.tiff", None)
    (tmp_path / name).write_text(writer(rpc))
    assert_same(read_rpc(image), rpc)


def test_tiff_tag(tmp_path: Path) -> None:
    rpc = make_rpc(11)
    assert_same(read_rpc(write_image(tmp_path / "a.tif", rpc)), rpc)


@pytest.mark.parametrize("option", ["RPCTXT", "RPB"])
def test_files_written_by_gdal(tmp_path: Path, option: str) -> None:
    rpc = make_rpc(12)
    image = write_image(tmp_path / "a.tif", rpc, **{option: "YES"})
    assert len(list(tmp_path.iterdir())) > 1
    assert_same(read_rpc(image), rpc)


def test_a_file_goes_before_the_tag(tmp_path: Path) -> None:
    image = write_image(tmp_path / "a.tif", make_rpc(13))
    better = make_rpc(14)
    (tmp_path / "a_RPC.TXT").write_text(rpc_text(better))
    assert_same(read_rpc(image), better)


def spoiled(name: str, old: str, new: str):
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return pytest.param(change, id=name)


@pytest.mark.parametrize(
    "change",
    [
        spoiled("missing-offset", "LINE_OFF:", "LINE:"),
        spoiled("missing-coefficient", "SAMP_DEN_COEFF_7:", "SAMP_DEN_7:"),
        spoiled("not-a-number", "LINE_NUM_COEFF_3: ", "LINE_NUM_COEFF_3: x"),
        spoiled("not-finite", "LINE_NUM_COEFF_3: ", "LINE_NUM_COEFF_3: nan "),
        spoiled("zero-scale", "LAT_SCALE: ", "LAT_SCALE: 0.0 "),
        spoiled("no-degrees", "LAT_OFF: ", "LAT_OFF: 4796000.0 "),
        spoiled("empty-value", "HEIGHT_OFF: ", "HEIGHT_OFF:\nX: "),
    ],
)
def test_malformed_text_is_refused(tmp_path: Path, change) -> None:
    image = write_image(tmp_path / "a.tif", None)
    (tmp_path / "a_RPC.TXT").write_text(change(rpc_text(make_rpc(15))))
    with pytest.raises(InputError, match=r"a_RPC.TXT: malformed RPC .*Remedy"):
        read_rpc(image)


@pytest.mark.parametrize(
    "change",
    [
        spoiled("19-coefficients", "lineNumCoef = (\n", "lineNumCoef = (\n //"),
        spoiled("missing-scale", "sampScale", "sampScal"),
        spoiled("RPC00A", "RPC00B", "RPC00A"),
        spoiled("cut-short", "sampDenCoef = (", "sampDenCoef = "),
    ],
)
def test_malformed_rpb_is_refused(tmp_path: Path, change) -> None:
    image = write_image(tmp_path / "a.tif", None)
    (tmp_path / "a.rpb").write_text(change(rpb_text(make_rpc(16))))
    with pytest.raises(InputError, match=r"a.rpb: malformed RPC .*Remedy"):
        read_rpc(image)


def test_images_without_rpc_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a.tif: image has no RPC metadata.*a_RPC.TXT"):
        read_rpc(write_image(tmp_path / "a.tif", None))
    with pytest.raises(InputError, match=r"b.tif: no such image"):
        read_rpc(tmp_path / "b.tif")
    (tmp_path / "c.tif").write_text("no raster")
    with pytest.raises(InputError, match=r"c.tif: not a raster"):
        read_rpc(tmp_path / "c.tif")
