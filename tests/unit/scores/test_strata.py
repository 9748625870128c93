"""Strata of a tile's labels: steps of the labels, status, classes, exact truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
import zarr

from stereobench.scores.strata import (
    Products,
    exact_truth,
    height_m_per_px,
    label_strata,
    near_step,
)
from stereotruth.core.products.grids import seal
from stereotruth.core.status import Status
from stereotruth.tiles.stereo_dataset import Pair

from ...synthetic.flat_orientation import GSD, RATIO, orientation

SIZE = 40
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_pixels_near_a_step_of_the_labels():
    labels = np.zeros((SIZE, SIZE), np.float32)
    labels[:, 20:] = 3.5
    labels[:, 18:20] = np.nan
    found = near_step(labels)
    expected = np.zeros((SIZE, SIZE), bool)
    expected[:, 15:18] = True  # the step's other side is at most 5 px away
    expected[:, 20:23] = True
    assert np.array_equal(found, expected)
    labels[labels > 0] = 3.0
    assert not near_step(labels).any()
    slope = np.tile(0.29 * np.arange(SIZE, dtype=np.float32), (SIZE, 1))
    assert not near_step(slope).any() and near_step(slope * 1.1)[20, 20]
    assert not near_step(np.full((5, 5), np.nan, np.float32)).any()


@pytest.fixture
def own(tmp_path):
    """A pair cut out of a scene at row 10, column 20, with status, classes and exact truth."""
    row = {"tile": "T_3", "scene": "T-1", "row0": "10", "col0": "20", "size": str(SIZE)}
    row |= {"city": "Town", "split": "test", "complete": "yes", "right_offset_px": "-7"}
    pair = Pair("T_3", "Town", "test", tmp_path, tmp_path, tmp_path, row)
    status = np.full((SIZE, SIZE), Status.LABELLED, np.uint8)
    status[5, 30] = Status.HIDDEN_IN_RIGHT
    (tmp_path / "tiles/Town/status").mkdir(parents=True)
    with rasterio.open(
        tmp_path / "tiles/Town/status/T_status_3.tiff",
        "w",
        driver="GTiff",
        height=SIZE,
        width=SIZE,
        count=1,
        dtype="uint8",
    ) as target:
        target.write(status, 1)
        meanings = ", ".join(f"{value:d} {value.name.lower()}" for value in Status)
        target.update_tags(TIFFTAG_IMAGEDESCRIPTION=meanings)
    layers = {
        "project": {"surface_class": np.uint8},
        "truth": dict.fromkeys(("changed", "changed_right", "visible", "hidden"), np.uint8)
        | {"surface": np.uint8, "disparity": np.float32},
    }
    stores = {}
    for kind, names in layers.items():
        group = zarr.open_group(tmp_path / kind / "Town/T-1.zarr", mode="w")
        group.attrs["complete"] = True
        for name, dtype in names.items():
            stores[name] = group.create_array(name, data=np.zeros((60, 70), dtype))
        seal(tmp_path / kind / "Town/T-1.zarr")
    return pair, Products(*(tmp_path / name for name in ("tiles", "project", "truth"))), stores


def test_status_and_classes_are_those_of_the_window(own):
    pair, products, stores = own
    classes = np.zeros((60, 70), np.uint8)
    classes[10, 20:25] = (2, 6, 5, 3, 9)
    stores["surface_class"][:] = classes
    found = label_strata(pair, np.zeros((SIZE, SIZE), np.float32), products)
    assert list(found) == [
        "near_step",
        "match_inside",
        "match_outside",
        "near_occlusion",
        "ground",
        "vegetation",
        "building",
        "other",
    ]
    near = found["near_occlusion"]
    assert near[:11, 25:36].all() and near.sum() == 11 * 11
    first = {name: found[name][0, :5].tolist() for name in ("ground", "building", "other")}
    assert first["ground"] == [True, False, False, False, False]
    assert first["building"] == [False, True, False, False, False]
    assert first["other"] == [False, False, False, False, True]
    assert found["vegetation"][0, :5].tolist() == [False, False, True, True, False]
    assert found["other"][1:].all()


def test_layers_of_the_dataset_are_strata(own):
    """Each value is in the bin that its bounds say, and one that is not known is in none."""
    pair, products, stores = own
    stores["surface_class"][:] = 2
    agl = np.full((SIZE, SIZE), np.nan, np.float32)
    agl[0, :7] = (-0.3, 1.9, 2.0, 9.9, 10.0, 29.9, 30.0)
    sigma = np.full((SIZE, SIZE), np.nan, np.float32)
    sigma[0, :5] = (0.01, 0.05, 0.1, 0.19, 0.7)
    layers = {"class": np.full((SIZE, SIZE), 6, np.uint8), "agl": agl, "uncertainty": sigma}
    found = label_strata(pair, np.zeros((SIZE, SIZE), np.float32), products, layers)
    assert found["building"].all() and not found["ground"].any()  # of the layer, not of the store
    wanted = {
        "agl_below_2_m": [0, 1],
        "agl_2_to_10_m": [2, 3],
        "agl_10_to_30_m": [4, 5],
        "agl_from_30_m": [6],
        "uncertainty_below_0.05_px": [0],
        "uncertainty_0.05_to_0.1_px": [1],
        "uncertainty_0.1_to_0.2_px": [2, 3],
        "uncertainty_from_0.2_px": [4],
    }
    assert list(found)[-8:] == list(wanted)
    for name, columns in wanted.items():
        assert np.argwhere(found[name]).tolist() == [[0, column] for column in columns], name


def test_exact_truth_is_taken_to_the_tile(own):
    """Less the right image's offset; without change and water."""
    pair, products, stores = own
    rng = np.random.default_rng(0)
    layer = {name: rng.integers(0, 2, (60, 70), dtype=np.uint8) for name in ("visible", "changed")}
    layer["changed_right"] = rng.integers(0, 2, (60, 70), dtype=np.uint8)
    layer["hidden"] = (1 - layer["visible"]).astype(np.uint8)
    layer["surface"] = rng.integers(0, 6, (60, 70), dtype=np.uint8)
    layer["disparity"] = rng.normal(0, 9, (60, 70)).astype(np.float32)
    for name, values in layer.items():
        stores[name][:] = values
    found = exact_truth(pair, products)
    here = {name: values[10:50, 20:60] for name, values in layer.items()}
    same = (here["changed"] == 0) & (here["changed_right"] == 0) & (here["surface"] != 5)
    for kind in ("visible", "hidden"):
        expected = np.where(same & (here[kind] == 1), here["disparity"] + 7, np.nan)
        assert np.array_equal(found[f"exact_{kind}"], expected, equal_nan=True)


def test_what_is_missing_is_left_out(own, tmp_path):
    pair, products, _ = own
    labels = np.zeros((SIZE, SIZE), np.float32)
    bare = Pair("T_3", "Town", "test", tmp_path, tmp_path, tmp_path)
    of_any_dataset = ["near_step", "match_inside", "match_outside"]
    assert list(label_strata(bare, labels, products)) == of_any_dataset
    assert list(label_strata(pair, labels, Products())) == of_any_dataset
    assert exact_truth(bare, products) == exact_truth(pair, Products()) == {}
    assert exact_truth(pair, Products(truth=tmp_path / "none")) == {}


def test_metres_of_height_come_from_the_orientation_of_the_tiles(own):
    pair, products, _ = own
    assert height_m_per_px([pair], products) is None  # no tile tells
    file = products.tiles / pair.city / "orientation" / f"{pair.row['tile']}.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps(orientation()))
    assert height_m_per_px([pair], products) == pytest.approx(GSD / RATIO, abs=1e-4)
    assert height_m_per_px([pair], Products()) is None
