"""The dataset as KITTI and US3D have theirs: read back by the project's readers, and by others."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stereotruth.core.products.rasters import read_disparity, read_image
from stereotruth.tiles.other_layouts import moved, shift_of, write_layout
from stereotruth.tiles.published_layout import assemble_dataset
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereotruth.tiles.verify import defects

from ...synthetic.images import write
from ...synthetic.other_programs import PROGRAMS
from ...synthetic.tiled_scene import SIZE, labels, make_scene, rows_of, run

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
RANGE = (-64, 200)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, found = tmp_path_factory.mktemp("dataset"), {}
    for kind in ("grey", "colour"):
        scene = make_scene(folder / kind / "s1", bare_from=240, colour=kind == "colour")
        run([scene], folder / kind / "Town")
        found[kind] = folder / kind / "dataset"
        assemble_dataset([folder / kind / "Town"], found[kind])
    return found


@pytest.fixture(scope="module", params=["kitti-grey", "kitti-colour", "us3d-grey", "us3d-colour"])
def written(request, datasets, tmp_path_factory) -> tuple[str, Path, Path]:
    layout, kind = request.param.split("-")
    out = tmp_path_factory.mktemp("layout") / layout
    assert write_layout(datasets[kind], out, layout) >= 10
    return layout, datasets[kind], out


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


def test_images_are_those_of_the_tiles(written) -> None:
    layout, dataset, out = written
    ours = {p.name: p for p in StereoDataset("a", dataset, "stereotruth", RANGE).pairs()}
    for row in rows_of(out)[::5]:
        left, right = (read_image(out / row[view]) for view in ("left", "right"))
        one = ours[row["tile"]]
        images = read_image(one.left), read_image(one.right)
        if layout == "kitti":
            shift = int(row["shift_px"])
            np.testing.assert_array_equal(left, images[0])
            np.testing.assert_array_equal(right[:, : SIZE - shift], images[1][:, shift:])
            assert (right[:, SIZE - shift :] == 0).all()
            continue
        low, high = float(row["black"]), float(row["white"])
        for found, image in zip((left, right), images):
            assert found.shape == (SIZE, SIZE, 3) and found.dtype == np.uint8
            image = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
            back = low + (found.astype(float) - 1) * (high - low) / 254
            inside = (image > low) & (image < high)
            assert np.abs(back - image)[inside].max() <= (high - low) / 254


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


def test_checksums_hold(written, tmp_path) -> None:
    _, _, out = written
    assert defects(out) == []


def test_disparities_of_png_are_positive() -> None:
    assert shift_of(np.array([[np.nan, -3.2, 7.0]], np.float32)) == 5
    assert shift_of(np.array([[2.0, np.nan]], np.float32)) == 0
    assert moved(np.array([[1, 2, 3, 4]]), 3).tolist() == [[4, 0, 0, 0]]
    assert not moved(np.array([[1, 2]]), 9).any()


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
