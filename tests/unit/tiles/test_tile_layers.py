from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from stereotruth.core.errors import InputError
from stereotruth.core.products.provenance import file_sha256
from stereotruth.tiles.layer_kinds import KINDS, NODATA
from stereotruth.tiles.other_layouts import write_layout
from stereotruth.tiles.published_layout import assemble_dataset
from stereotruth.tiles.scene_stores import SceneFiles, open_stores
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereotruth.tiles.tile_layers import tile_layers
from stereotruth.tiles.verify import defects

from ...synthetic.tiled_scene import labels, make_scene, read, rows_of, run, terrain

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
ALL = ("height", "class", "agl", "uncertainty", "lidar_date")


@pytest.fixture(scope="module")
def tiles(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("layers") / "Town"
    run([scene], folder, layers=ALL)
    return folder


def test_each_labelled_tile_has_the_layers_that_are_asked_for(tiles):
    rows = rows_of(tiles)
    assert defects(tiles) == []
    for row in rows:
        for name in ALL:
            file = row[f"layer_{name}"]
            if row["complete"] == "no":
                assert file == row[f"layer_{name}_sha256"] == ""
                continue
            assert file == f"{name}/TN_{name}_{row['number']}.tiff"
            assert row[f"layer_{name}_sha256"] == file_sha256(tiles / file)
            with rasterio.open(tiles / file) as source:
                assert source.dtypes == (KINDS[name].dtype,)
                assert source.nodata == KINDS[name].nodata


def test_nothing_else_of_the_tiles_depends_on_the_layers(tiles, exported):
    plain = {path.relative_to(exported[0]) for path in exported[0].rglob("*.tiff")}
    for path in plain:
        assert (tiles / path).read_bytes() == (exported[0] / path).read_bytes()
    layers = {path.relative_to(tiles) for path in tiles.rglob("*.tiff")} - plain
    assert {path.parent.name for path in layers} == set(ALL)


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

    assert write_layout(tmp_path / "dataset", tmp_path / "us3d", "us3d") > 0
    (agl,) = (tmp_path / "us3d").rglob(f"{pair.name}_LEFT_AGL.tif")
    (classes,) = (tmp_path / "us3d").rglob(f"{pair.name}_LEFT_CLS.tif")
    assert (np.isfinite(read(agl)) == np.isfinite(height)).all()
    assert (read(classes) == 65).all()
    assert defects(tmp_path / "us3d") == []


def test_a_layer_that_the_dataset_has_not_is_refused(exported, tmp_path):
    assemble_dataset([exported[0]], tmp_path / "dataset")
    dataset = StereoDataset("mine", tmp_path / "dataset", "stereotruth", (-64, 64))
    with pytest.raises(InputError, match=r"no layer agl.*tiles\.layers: \[agl\]"):
        dataset.layer(dataset.pairs(labelled=True)[0], "agl")


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


def test_days_that_nobody_knows_are_empty(tiles):
    for row in rows_of(tiles):
        assert row["lidar_days_left"] == row["lidar_days_right"] == ""
