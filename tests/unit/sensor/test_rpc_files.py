"""The readers of each format of RPC files."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.sensor.rpc import RPC
from stereotruth.sensor.rpc_files import read_rpc, rpc_file

from ...synthetic import rpc_texts
from ...synthetic.cameras import ground_points, make_rpc
from ...synthetic.images import write_image


def rpc_text(rpc: RPC) -> str:
    return rpc_texts.rpc_text(rpc.to_dict(), units=True)


def rpb_text(rpc: RPC, spec: str = "RPC00B") -> str:
    return rpc_texts.rpb_text(rpc.to_dict(), spec, ("\terrBias = 0.0;", "\terrRand = 0.0;"))


def assert_same(a: RPC, b: RPC) -> None:
    lon, lat, height = ground_points(b, 50)
    difference = np.subtract(a.project(lon, lat, height), b.project(lon, lat, height))
    assert np.abs(difference).max() < 1e-5  # offsets are written with ten decimals


@pytest.mark.parametrize(
    ("name", "writer"),
    [
        ("GF7_scene-BWD_RPC.TXT", rpc_text),
        ("GF7_scene-BWD.rpb", rpb_text),
    ],
)
def test_files_beside_the_image(tmp_path: Path, name: str, writer) -> None:
    rpc = make_rpc(10)
    image = write_image(tmp_path / "GF7_scene-BWD.tiff", None)
    for encoding in ("utf-8", "utf-8-sig"):
        (tmp_path / name).write_text(writer(rpc), encoding=encoding)
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


TEXT_FAULTS = {
    "missing-offset": ("LINE_OFF:", "LINE:"),
    "missing-coefficient": ("SAMP_DEN_COEFF_7:", "SAMP_DEN_7:"),
    "not-a-number": ("LINE_NUM_COEFF_3: ", "LINE_NUM_COEFF_3: x"),
    "zero-scale": ("LAT_SCALE: ", "LAT_SCALE: 0.0 "),
    "no-degrees": ("LAT_OFF: ", "LAT_OFF: 4796000.0 "),
    "empty-value": ("HEIGHT_OFF: ", "HEIGHT_OFF:\nX: "),
    "two-numbers": ("LINE_SCALE: ", "LINE_SCALE: 14 "),
    "twice": ("LINE_SCALE: ", "LINE_SCALE: 14001.0 pixels\nLINE_SCALE: "),
    "huge-term": ("LINE_NUM_COEFF_3: ", "LINE_NUM_COEFF_3: 1e30\nX: "),
    "long": ("LINE_OFF: ", "X: " + "y" * 2_000_000 + "\nLINE_OFF: "),
}
RPB_FAULTS = {
    "19-coefficients": ("lineNumCoef = (\n", "lineNumCoef = (\n //"),
    "missing-scale": ("sampScale", "sampScal"),
    "RPC00A": ("RPC00B", "RPC00A"),
    "cut-short": ("sampDenCoef = (", "sampDenCoef = "),
}
FAULTS = [("a_RPC.TXT", rpc_text, *change) for change in TEXT_FAULTS.values()]
FAULTS += [("a.rpb", rpb_text, *change) for change in RPB_FAULTS.values()]


@pytest.mark.parametrize(("name", "writer", "old", "new"), FAULTS, ids=[*TEXT_FAULTS, *RPB_FAULTS])
def test_malformed_files_are_refused(tmp_path: Path, name, writer, old, new) -> None:
    image, text = write_image(tmp_path / "a.tif", None), writer(make_rpc(15))
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=rf"{name}: .*Remedy"):
        read_rpc(image)


@pytest.mark.parametrize("filling", ["\n", " ", "a=(", "("])
@pytest.mark.parametrize(("name", "writer"), [("a_RPC.TXT", rpc_text), ("a.rpb", rpb_text)])
def test_long_files_take_no_longer_than_their_length(tmp_path, name, writer, filling) -> None:
    """200 000 blank lines took a pattern hours. Whatever comes of it, it comes."""
    image = write_image(tmp_path / "a.tif", None)
    rpc = make_rpc(17)
    (tmp_path / name).write_text(filling * (400_000 // len(filling)) + "\n" + writer(rpc))
    if filling.isspace():
        assert_same(read_rpc(image), rpc)
        return
    with contextlib.suppress(InputError):
        read_rpc(image)


def test_where_an_rpc_comes_from(tmp_path: Path) -> None:
    image = write_image(tmp_path / "a.tif", make_rpc(13))
    assert rpc_file(image) == image
    better = make_rpc(14)  # a file goes before the tag
    (tmp_path / "A_rpc.txt").write_text(rpc_text(better))
    assert rpc_file(image) == tmp_path / "A_rpc.txt"
    assert_same(read_rpc(image), better)


@pytest.mark.parametrize(
    ("image", "xml", "text"),
    [
        ("13OCT.TIF", "13OCT.XML", rpc_texts.vantor_text),
        ("13OCT.TIF", "13OCT.XML", lambda v: rpc_texts.vantor_text(v, "urn:of:a:supplier")),
        ("IMG_PHR1A_P_R1C1.TIF", "RPC_PHR1A_P.XML", rpc_texts.dimap_text),
        ("IMG_PNEO3_F_1_P_R1C1.TIF", "RPC_PNEO3_F_1_P.XML", lambda v: rpc_texts.dimap_text(v, 3)),
    ],
)
def test_xml_of_suppliers(tmp_path: Path, image: str, xml: str, text) -> None:
    rpc = make_rpc(15)
    file = write_image(tmp_path / image, None)
    (tmp_path / xml).write_text(text(rpc.to_dict()))
    assert_same(read_rpc(file), rpc)


def test_xml_without_an_rpc_is_none(tmp_path: Path) -> None:
    image = write_image(tmp_path / "a.tif", None)
    for text in ("<ProductMetaData/>", "<ProductMetaData>", rpc_texts.vantor_text({})):
        (tmp_path / "a.xml").write_text(text)
        with pytest.raises(InputError):
            read_rpc(image)


def test_images_without_rpc_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a.tif: .*a_RPC.TXT"):
        read_rpc(write_image(tmp_path / "a.tif", None))
    with pytest.raises(InputError, match=r"b.tif: "):
        read_rpc(tmp_path / "b.tif")
    (tmp_path / "c.tif").write_text("no raster")
    with pytest.raises(InputError, match=r"c.tif: "):
        read_rpc(tmp_path / "c.tif")
