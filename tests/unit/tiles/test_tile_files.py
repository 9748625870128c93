"""The files of a tile, as other programs read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
import zarr
from scipy.ndimage import map_coordinates

from stereotruth.core.errors import InputError
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import read_image, read_tile, write_tiff
from stereotruth.tiles.layouts import assemble_dataset, write_layout
from stereotruth.tiles.manifest import KINDS, NODATA
from stereotruth.tiles.scene_stores import SceneFiles, open_stores
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereotruth.tiles.tile_files import round_disparity, tile_layers
from stereotruth.tiles.verify import defects

from ...synthetic.other_programs import PROGRAMS
from ...synthetic.pictures import colours_in, read_picture
from ...synthetic.tiled_scene import SIZE, labels, make_scene, read, rows_of, run, terrain

ALL = ("height", "class", "agl", "uncertainty", "lidar_date")
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_right_tile_warped_by_the_disparity_is_the_left_tile(exported: tuple[Path, dict]) -> None:
    folder, _ = exported
    checked = 0
    for row in rows_of(folder):
        if row["complete"] == "yes":
            left, right = (read(folder / row[k]).astype(np.float64) for k in ("left", "right"))
            disparity = labels(folder / row["disp"])
            y, x = np.mgrid[:SIZE, :SIZE]
            match = x - disparity
            use = np.isfinite(disparity) & (match > 4) & (match < SIZE - 5)
            warped = map_coordinates(right, [y[use], match[use]], order=3)
            # Texture ±360, 0.02 px of cubic interpolation: 1 to 2 grey values.
            assert np.abs(warped - left[use]).mean() < 2.5
            shifted = map_coordinates(right, [y[use], match[use] + 1.0], order=3)
            assert np.abs(shifted - left[use]).mean() > 10
            checked += 1
    assert checked >= 12


def test_half_precision_tiff(tmp_path: Path) -> None:
    values = np.linspace(-200, 200, 64 * 64).reshape(64, 64)
    stored = round_disparity(values, "float16")
    assert np.abs(stored - values)[np.abs(values) < 128].max() <= 1 / 32
    assert np.abs(stored - values).max() <= 1 / 16
    path = tmp_path / "half.tiff"
    write_tiff(path, stored, nodata=-999, half=True)
    with rasterio.open(path) as dataset:
        assert np.array_equal(dataset.read(1), stored) and dataset.nodata == -999


@pytest.fixture(scope="module")
def tiles(scene: SceneFiles, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tiles with all layers, and labels of the right view (those of the left: files matter)."""
    folder = tmp_path_factory.mktemp("all") / "Town"
    run([scene._replace(disparity_of_right=scene.disparity)], folder, layers=ALL)
    return folder


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_opens_the_tiles(tiles: Path, scene: SceneFiles, program: str) -> None:
    """What each reads are the values of the scene's stores."""
    left, right, labels_of = (
        zarr.open_group(path, mode="r") for path in (scene.left, scene.right, scene.disparity)
    )
    for row in rows_of(tiles)[::5]:
        assert float(row["disparity_rounding_px"] or 0) <= 1 / 2048
        offset = int(row["right_offset_px"])
        rows = slice(int(row["row0"]), int(row["row0"]) + SIZE)
        here = (rows, slice(int(row["col0"]), int(row["col0"]) + SIZE))
        there = (rows, slice(here[1].start - offset, here[1].stop - offset))
        wanted = {"left": left["image"][here], "right": right["image"][there]}
        if row["complete"] == "yes":
            for end, window in (("", here), ("_right", there)):
                disparity = labels_of["disparity"][window].astype(np.float64) - offset
                wanted[f"disp{end}"] = np.where(np.isfinite(disparity), disparity, -999)
                wanted[f"status{end}"] = labels_of["status"][window]
        for kind, values in wanted.items():
            found = PROGRAMS[program](tiles / row[kind])
            if kind.startswith("disp"):
                assert found.dtype == np.float32
                assert np.abs(found - values).max() <= 1 / 2048
                assert np.array_equal(found == -999, values == -999)
            else:
                assert found.dtype == values.dtype
                assert np.array_equal(found, values)


def test_tiles_in_colour_are_read_like_others(in_colour, exported: tuple[Path, dict]) -> None:
    """Same windows and labels as of the grey image; the project's readers give both."""
    folder, _ = in_colour
    row = rows_of(folder)[0]
    wanted = read_image(folder / row["left"])
    for name, program in PROGRAMS.items():
        found = program(folder / row["left"])
        np.testing.assert_array_equal(found, wanted >> 8 if name == "Pillow" else wanted)
    for row, grey in zip(rows_of(folder), rows_of(exported[0])):
        for column in ("row0", "col0", "disp_sha256", "split", "sift_matches", "warp_correlation"):
            assert row[column] == grey[column]
        assert row["left_sha256"] != grey["left_sha256"]
        image = read_image(folder / row["left"])
        assert image.shape == (SIZE, SIZE, 3)
        np.testing.assert_array_equal(image[..., 0], read_image(exported[0] / grey["left"]))
        mean = read_tile(folder / row["left"])
        np.testing.assert_array_equal(mean, image.mean(axis=2))
    contact = read_picture(folder.parent / "contact.png")
    assert colours_in(contact) > 0.1


def test_the_papers_16_bits_can_be_chosen(scene: SceneFiles, tmp_path: Path) -> None:
    run([scene], tmp_path / "T", disparity_dtype="float16")
    row = rows_of(tmp_path / "T")[0]
    with rasterio.open(tmp_path / "T" / row["disp"]) as dataset:
        half = dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS") == "16"  # before GDAL 3.11
        assert half or dataset.dtypes == ("float16",)
    values = labels(tmp_path / "T" / row["disp"])
    assert 1e-4 < float(row["disparity_rounding_px"]) <= 1 / 128
    assert np.array_equal(values.astype(np.float16), values, equal_nan=True)


# ------------------------------------------------------------------ layers


def test_each_labelled_tile_has_the_layers_that_are_asked_for(tiles):
    rows = rows_of(tiles)
    assert defects(tiles) == []
    for row in rows:
        for name in ALL:
            file = row[f"layer_{name}"]
            if row["complete"] == "no":
                assert file == row[f"layer_{name}_sha256"] == ""
                assert row["lidar_days_left"] == row["lidar_days_right"] == ""
                continue
            assert file == f"{name}/TN_{name}_{row['number']}.tiff"
            assert row[f"layer_{name}_sha256"] == file_sha256(tiles / file)
            with rasterio.open(tiles / file) as source:
                assert source.dtypes == (KINDS[name].dtype,)
                assert source.nodata == KINDS[name].nodata


def test_heights_are_those_that_the_labels_were_made_of(scene):
    source = open_stores(scene)
    here = np.s_[64:128, 96:160]
    found = tile_layers(source, here, ALL)
    known = np.isfinite(source.disparity[here])
    true = source.height[here]
    assert np.abs(found["height"][known] - true[known]).max() < 0.01
    assert (found["height"][~known] == NODATA).all()
    assert (found["agl"][known] > -12).all() and (found["agl"][~known] == NODATA).all()
    assert (found["lidar_date"] == 0).all()
    assert (found["uncertainty"] == NODATA).all() and (found["class"] == 0).all()
    assert true[known].min() > terrain(0.0, 0.0) - 20  # the store has heights at all


def test_layers_reach_the_dataset_us3d_and_python(tiles, tmp_path):
    assemble_dataset([tiles], tmp_path / "dataset")
    assert defects(tmp_path / "dataset") == []
    dataset = StereoDataset("mine", tmp_path / "dataset", "stereotruth", (-64, 64))
    pair = dataset.pairs(labelled=True)[0]
    height = dataset.layer(pair, "height")
    assert (np.isfinite(height) == np.isfinite(dataset.labels(pair))).all()
    assert dataset.layer(pair, "class").dtype == np.uint8
    with pytest.raises(InputError):
        dataset.layer(dataset.pairs()[-1], "slope")
    assert write_layout(tmp_path / "dataset", tmp_path / "us3d", "us3d") > 0
    (agl,) = (tmp_path / "us3d").rglob(f"{pair.name}_LEFT_AGL.tif")
    (classes,) = (tmp_path / "us3d").rglob(f"{pair.name}_LEFT_CLS.tif")
    assert (np.isfinite(read(agl)) == np.isfinite(height)).all()
    assert (read(classes) == 65).all()
    assert defects(tmp_path / "us3d") == []


@pytest.fixture(scope="module")
def dated(tmp_path_factory) -> SceneFiles:
    """LiDAR of 2020-01-01 and, in the right half, of 2021-01-01."""
    folder = tmp_path_factory.mktemp("dated") / "Town-1"
    return make_scene(folder, lidar_days=(18_262, 18_628), acquired=("2020-01-11", None))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("by_sheet", "days"),
    [
        (("", ""), {"left": (10, -356), "right": ("", "")}),
        (("2019-12-31", "2021-01-02"), {"left": (-1, -367), "right": (367, 1)}),
    ],
)
def test_the_manifest_has_the_days_from_lidar_to_images(dated, tmp_path, by_sheet, days):
    """The sheet goes before the delivery; a tile has the median of its labels."""
    run([dated._replace(acquired=by_sheet)], tmp_path / "Town", layers=("lidar_date",))
    sides = set()
    for row in rows_of(tmp_path / "Town"):
        if row["complete"] == "no":
            continue
        layer = read(tmp_path / "Town" / row["layer_lidar_date"])
        known = np.isfinite(labels(tmp_path / "Town" / row["disp"]))
        assert set(layer[known].tolist()) <= {18_262, 18_628} and not layer[~known].any()
        side = int((layer[known] == 18_628).mean() >= 0.5)
        sides.add(side)
        for view, expected in days.items():
            assert row[f"lidar_days_{view}"] == str(expected[side])
    assert sides == {0, 1}
