"""Labels sealed and opened: what the copy holds, and which labels open it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import read_sealed, write_sealed, write_table
from stereotruth.core.products.provenance import file_sha256
from stereotruth.tiles.seals import FILE, Seal, open_seal, seal_dataset
from stereotruth.tiles.stereo_dataset import StereoDataset, find_pairs

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
NAMES = {
    "whu": "{split}/{kind}/KM_{word}_{n}.tiff",
    "stereotruth": "with ground truth/{split}/{kind}/KM_{word}_{n}.tiff",
    "us3d": "{split}/JAX_{n}_{us3d}.tif",
    "kitti": "{split}/{kitti}/KM_{n}_10.png",
}
WORDS = {
    "left": ("left", "LEFT_RGB", "image_2"),
    "right": ("right", "RIGHT_RGB", "image_3"),
    "disp": ("disparity", "LEFT_DSP", "disp_occ_0"),
}


@pytest.fixture(params=NAMES)
def dataset(request, tmp_path) -> StereoDataset:
    """Two test pairs and a training pair; with a manifest and a layer in the first layout."""
    root, rows = tmp_path / "whole", []
    for n, split in enumerate(("test", "test", "train")):
        row = {"tile": f"KM_{n}", "city": "Kunming", "scene": "A", "split": split, "quality": "ok"}
        for kind, (word, us3d, kitti) in WORDS.items():
            words = {"split": split, "kind": kind, "word": word, "n": n, "us3d": us3d}
            name = NAMES[request.param].format(**words, kitti=kitti)
            dtype = np.uint16 if name.endswith("png") or kind != "disp" else np.float32
            write(root / name, np.full((4, 6), 100 + n, dtype))
            row |= {kind: name, f"{kind}_sha256": file_sha256(root / name)}
        layer = f"with ground truth/{split}/height/KM_height_{n}.tiff"
        if request.param == "stereotruth":
            write(root / layer, np.ones((4, 6), np.float32))
            rows.append(row | {"layer_height": layer})
    if rows:
        write_table(root / "manifest.csv", rows)
    return StereoDataset("set", root, request.param, (-8, 128))


def sealed(dataset: StereoDataset, to: Path) -> StereoDataset:
    seal_dataset(dataset.root, find_pairs(dataset.root, dataset.layout), "test", to)
    return StereoDataset("set", to, dataset.layout, dataset.disparity_range)


def test_nothing_that_is_there_is_replaced(dataset, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/gcps.csv").touch()
    before = sorted(tmp_path.rglob("*"))
    for to in (dataset.root, dataset.root / "public", tmp_path / "mine"):
        with pytest.raises(InputError):
            sealed(dataset, to)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_sealed_copy_is_matched_but_not_scored_until_it_is_opened(dataset, tmp_path):
    copy = sealed(dataset, tmp_path / "copy")
    assert [pair.disparity for pair in copy.pairs("test")] == [None, None]
    assert len(copy.pairs("train", labelled=True)) == 1
    with pytest.raises(InputError):
        copy.pairs("test", labelled=True)
    told = (tmp_path / "copy" / FILE).read_text()
    names = {p.relative_to(copy.root).as_posix() for p in Path(copy.root).rglob("*.*")}
    assert not {name for name in Seal.of(copy.root).files if name != "manifest.csv"} & names
    assert copy.seal in told and dataset.seal == ""
    open_seal(copy.root, dataset.root)
    assert len(copy.pairs("test", labelled=True)) == 2
    for pair in copy.pairs("test"):
        pair.refuse_changed()
        assert np.nanmax(copy.labels(pair)) >= 100 / 256
    if dataset.layout == "stereotruth":
        assert copy.layer(copy.pairs("test")[0], "height").any()


def test_labels_that_are_not_the_sealed_ones_open_nothing(dataset, tmp_path):
    copy = sealed(dataset, tmp_path / "copy")
    other = tmp_path / "other"
    shutil.copytree(dataset.root, other)
    label = next(name for name in Seal.of(copy.root).pairs.values())
    shutil.copyfile(find_pairs(other, dataset.layout)[-1].left, other / label)
    with pytest.raises(InputError) as refused:
        open_seal(copy.root, other)
    assert refused.value.file == str(other / label)
    assert all(pair.disparity is None for pair in copy.pairs("test"))
    open_seal(copy.root, dataset.root)  # and edited afterwards
    shutil.copyfile(other / label, Path(copy.root) / label)
    with pytest.raises(InputError):
        for pair in copy.pairs("test", labelled=True):
            pair.refuse_changed()


def test_a_label_that_is_not_that_of_the_manifest_is_not_sealed(dataset, tmp_path):
    (pair,) = dataset.pairs("train")
    shutil.copyfile(pair.left, pair.disparity)
    if pair.row:
        with pytest.raises(InputError) as refused:
            sealed(dataset, tmp_path / "copy")
        assert refused.value.file == str(pair.disparity)
    else:  # nothing tells
        sealed(dataset, tmp_path / "copy")


def test_a_list_that_was_exchanged_is_no_seal(dataset, tmp_path):
    copy = sealed(dataset, tmp_path / "copy")
    file = Path(copy.root) / FILE
    values = read_sealed(file)
    values["files"] = dict.fromkeys(values["files"], "0" * 64)
    write_sealed(values, file)
    with pytest.raises(InputError):
        copy.pairs("test")
    file.write_text(json.dumps({"split": "test"}))
    with pytest.raises(InputError):
        copy.pairs("test")
