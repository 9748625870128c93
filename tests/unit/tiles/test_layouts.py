"""The dataset, and its other layouts by several readers."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_disparity, read_image
from stereotruth.tiles.layouts import assemble_dataset, write_layout
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereotruth.tiles.verify import defects

from ...synthetic.images import write
from ...synthetic.other_programs import PROGRAMS
from ...synthetic.tiled_scene import SIZE, labels, rows_of

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
RANGE = (-64, 200)


def renamed(folder: Path, out: Path) -> Path:
    """The same tiles as another city, with training and testing exchanged."""
    shutil.copytree(folder, out)
    for file in out.rglob("TN_*"):
        file.rename(file.with_name(file.name.replace("TN_", "AA_")))
    for file in (out / "manifest.csv", out / "footprints.geojson"):
        file.write_text(file.read_text().replace("TN_", "AA_"))
    table = (out / "manifest.csv").read_text()
    for one, other in ((",train,", ",?,"), (",test,", ",train,"), (",?,", ",test,")):
        table = table.replace(one, other)
    (out / "manifest.csv").write_text(table)
    return out


def test_published_layout(exported, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cities, out = [exported[0], renamed(exported[0], tmp_path / "B")], tmp_path / "dataset"
    summary = assemble_dataset(cities, out)
    given = [row for city in cities for row in rows_of(city)]
    assert sum(summary["pairs"].values()) == len(given)
    one, other = summary["shared_ground"][0]
    assert {one[:2], other[:2]} == {"TN", "AA"} and f"{one} and {other} share" in caplog.text
    rows = rows_of(out)
    for row, before in zip(rows, given):
        place = f"with ground truth/{row['split']}" if row["disp"] else "without ground truth"
        for kind in ("left", "right", *(("disp",) if row["disp"] else ())):
            assert row[kind] == f"{place}/{kind}/{Path(before[kind]).name}"
            assert (out / row[kind]).is_file()
    assert defects(out) == [] and "orientation" not in rows[0]
    (out / rows[0]["left"]).write_text("edited")  # a copy: the tiles stay
    assert defects(cities[0]) == [] and len(defects(out)) == 1
    assemble_dataset(cities, out)  # replaces what was there
    assert defects(out) == []


def test_refusals(exported, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="TN_0 is in"):
        assemble_dataset([exported[0], exported[0]], tmp_path / "d")
    city = renamed(exported[0], tmp_path / "A")
    (city / "right" / "AA_right_1.tiff").write_text("edited")
    for folder in (tmp_path / "nowhere", city):
        with pytest.raises(InputError):
            assemble_dataset([folder], tmp_path / "d")
    assert not (tmp_path / "d").exists() and not list(tmp_path.glob("*.partial"))


# ------------------------------------------------------------------ other layouts


@pytest.fixture(scope="module", params=["kitti-grey", "us3d-colour"])
def written(request, exported, in_colour, tmp_path_factory) -> tuple[str, Path, Path]:
    layout, kind = request.param.split("-")
    folder = tmp_path_factory.mktemp("layout")
    dataset, out = folder / "dataset", folder / layout
    assemble_dataset([(exported if kind == "grey" else in_colour)[0]], dataset)
    assert write_layout(dataset, out, layout) >= 10
    assert defects(out) == []
    return layout, dataset, out


def test_the_readers_give_the_same_disparities(written) -> None:
    layout, dataset, out = written
    ours = {p.name: p for p in StereoDataset("a", dataset, "stereotruth", RANGE).pairs()}
    rows = {row["tile"]: row for row in rows_of(out)}
    there = StereoDataset("b", out, layout, RANGE)
    pairs = there.pairs(labelled=True)
    assert {p.name for p in pairs} == {n for n, p in ours.items() if p.disparity}
    for pair in pairs:
        one, row = ours[pair.name], rows[pair.name]
        assert (pair.split, row["split"]) == (one.split, one.split)
        wanted = labels(one.disparity)
        shift, rounding = (int(row["shift_px"]), 1 / 512) if layout == "kitti" else (0, 0)
        found = there.labels(pair) - shift
        assert np.array_equal(np.isfinite(found), np.isfinite(wanted))
        assert np.nanmax(np.abs(found - wanted)) <= rounding + 1e-6
        assert int(row["right_offset_px"]) + shift == int(one.row["right_offset_px"])
        # the images show each other at these disparities, as the tiles do
        left, right = (read_image(file).astype(float) for file in (pair.left, pair.right))
        if left.ndim == 3:
            left, right = left.mean(axis=2), right.mean(axis=2)
        y, x = np.nonzero(np.isfinite(found))
        match = np.rint(x - there.labels(pair)[y, x]).astype(int)
        inside = (match > 0) & (match < SIZE - shift - 1)
        a, b = left[y[inside], x[inside]], right[y[inside], match[inside]]
        assert np.corrcoef(a, b)[0, 1] > 0.98


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_opens_them(written, program: str) -> None:
    layout, _, out = written
    if layout == "kitti" and program == "tifffile":
        pytest.skip("tifffile is for TIFFs")
    row = rows_of(out)[0]
    disparity = PROGRAMS[program](out / row["disp"])
    if layout == "kitti":
        raw = cv2.imread(str(out / row["disp"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(disparity, raw)
    else:
        assert disparity.dtype == np.float32
    image, wanted = PROGRAMS[program](out / row["left"]), read_image(out / row["left"])
    if image.dtype == np.uint8 and wanted.dtype == np.uint16:
        wanted = wanted >> 8  # Pillow has 8 bits of each colour
    np.testing.assert_array_equal(image, wanted)


def test_kittis_own_files_are_read(tmp_path) -> None:
    for place in ("image_2", "image_3", "disp_occ_0"):
        (tmp_path / "training" / place).mkdir(parents=True)
        values = np.full((4, 6), 1000, np.uint16)
        values[0, 0] = 0
        Image.fromarray(values).save(tmp_path / "training" / place / "000004_10.png")
    (pair,) = (found := StereoDataset("k", tmp_path, "kitti", (0, 192))).pairs("train")
    assert (pair.name, pair.split) == ("000004", "train")
    disparity = found.labels(pair)
    assert np.isnan(disparity[0, 0]) and disparity[1, 1] == np.float32(1000 / 256)
    tiff = write(tmp_path / "t.tif", np.full((4, 6), 1000, np.uint16))
    assert (read_disparity(tiff) == 1000).all()  # a TIFF is as it says
