"""Datasets on disk, in the three layouts and in none."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_disparity, read_image
from stereotruth.tiles.stereo_dataset import StereoDataset, StereoTiles, find_pairs

from ...synthetic.images import write
from ...synthetic.real_data import PUBLISHED

needs_published = pytest.mark.skipif(not PUBLISHED.is_dir(), reason="no published pairs here")
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def whu_pair(folder: Path, name: str, *, kinds=("left", "right", "disparity")) -> None:
    prefix, number = name.split("_")
    for kind in kinds:
        place = folder / ("disp" if kind == "disparity" else kind)
        write(place / f"{prefix}_{kind}_{number}.tiff", np.ones((4, 6), np.uint16))


def us3d_pair(folder: Path, name: str, endings=("LEFT_RGB", "RIGHT_RGB", "LEFT_DSP")) -> None:
    for ending in endings:
        bands = 3 if "RGB" in ending else 1
        write(folder / f"{name}_{ending}.tif", np.ones((4, 6, bands), np.uint8))


def test_the_published_layout_is_read_with_and_without_truth(tmp_path):
    for split in ("train", "val", "test"):
        whu_pair(tmp_path / "with ground truth" / split, f"KM_{len(split)}")
    whu_pair(tmp_path / "without ground truth", "WH_7", kinds=("left", "right"))
    for layout in ("whu", "stereotruth"):  # the latter without its manifest
        pairs = find_pairs(tmp_path, layout)
        assert [(p.name, p.city, p.split) for p in pairs] == [
            ("WH_7", "Wuhan", "none"),
            ("KM_4", "Kunming", "test"),
            ("KM_5", "Kunming", "train"),
            ("KM_3", "Kunming", "val"),
        ]
        assert [p.disparity is None for p in pairs] == [True, False, False, False]
        assert all(file.is_file() for p in pairs for file in (p.left, p.right))


def test_splits_may_be_links_to_another_disk(tmp_path):
    for split in ("train", "test"):
        whu_pair(tmp_path / "disk" / split, "KM_1")
    whole = tmp_path / "whole"
    whole.mkdir()
    for split in ("train", "test"):
        (whole / split).symlink_to(tmp_path / "disk" / split)
    (tmp_path / "disk" / "test" / "back").symlink_to(whole)  # leads in a circle
    pairs = find_pairs(whole, "whu")
    assert [pair.name for pair in pairs] == ["test_KM_1", "train_KM_1"]  # one name in two splits
    assert sorted(p.split for p in pairs) == ["test", "train"]
    assert all(file.is_file() for p in pairs for file in (p.left, p.right, p.disparity))


def test_the_own_layout_follows_its_manifest(tmp_path):
    whu_pair(tmp_path / "x", "ZZ_1")
    rows = [
        "tile,city,split,left,right,disp,scene",
        "ZZ_1,Zed,val,x/left/ZZ_left_1.tiff,x/right/ZZ_right_1.tiff,x/disp/ZZ_disparity_1.tiff,Z-1",
        "ZZ_2,Zed,test,x/left/ZZ_left_1.tiff,x/right/ZZ_right_1.tiff,,Z-1",
    ]
    (tmp_path / "manifest.csv").write_text("\n".join(rows) + "\n")
    none, val = find_pairs(tmp_path, "stereotruth")
    assert (val.name, val.city, val.split, val.row["scene"]) == ("ZZ_1", "Zed", "val", "Z-1")
    assert none.split == "none" and none.disparity is None


def test_us3d_may_keep_its_truth_elsewhere(tmp_path):
    us3d_pair(tmp_path / "Train-Track2-RGB-1", "JAX_004_007_006", ("LEFT_RGB", "RIGHT_RGB"))
    us3d_pair(tmp_path / "Train-Track2-Truth", "JAX_004_007_006", ("LEFT_DSP",))
    us3d_pair(tmp_path / "Validate-Track2", "OMA_247_027_001", ("LEFT_RGB", "RIGHT_RGB"))
    us3d_pair(tmp_path / "flat", "XYZ_1_2_3")
    found = {p.name: (p.city, p.split, p.disparity is None) for p in find_pairs(tmp_path, "us3d")}
    assert found == {
        "JAX_004_007_006": ("Jacksonville", "train", False),
        "OMA_247_027_001": ("Omaha", "val", True),
        "XYZ_1_2_3": ("XYZ", "test", False),
    }


def no_partner(root: Path) -> None:
    us3d_pair(root, "JAX_1_2_3", ("LEFT_RGB",))


def two_of_a_name(root: Path) -> None:
    us3d_pair(root, "JAX_1_2_3")
    us3d_pair(root / "again", "JAX_1_2_3")


def not_all_labels(root: Path) -> None:
    whu_pair(root / "train", "KM_1")
    whu_pair(root / "train", "KM_2", kinds=("left", "right"))


def twice(root: Path) -> None:
    whu_pair(root / "train", "KM_1")
    shutil.copytree(root / "train", root / "copy" / "train")


def odd_name(*files: str):
    def make(root: Path) -> None:
        for file in files:
            (root / file).parent.mkdir(parents=True, exist_ok=True)
            (root / file).touch()

    return make


REFUSED = {
    "nothing of the layout": ("whu", lambda root: us3d_pair(root, "JAX_1_2_3")),
    "no such layout": ("middlebury", lambda root: None),
    "no partner": ("us3d", no_partner),
    "a name twice": ("us3d", two_of_a_name),
    "a pair twice": ("whu", twice),
    "labels missing": ("whu", not_all_labels),
    # names of files become names of products, and keys of tables
    "backslash": ("whu", odd_name("S\\G_left_1.tiff", "S\\G_right_1.tiff")),
    "bell": ("us3d", odd_name("A\aB_LEFT_RGB.tif", "A\aB_RIGHT_RGB.tif")),
    "dots": ("kitti", odd_name("image_2/.._10.png", "image_3/.._10.png")),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_folders_that_cannot_be_used_are_refused(tmp_path, fault):
    layout, make = REFUSED[fault]
    make(tmp_path)
    with pytest.raises(InputError) as refused:
        find_pairs(tmp_path, layout)
    assert refused.value.file and refused.value.remedy
    with pytest.raises(InputError):
        find_pairs(tmp_path / "nowhere", layout)


def test_a_split_without_pairs_is_refused(tmp_path):
    whu_pair(tmp_path / "train", "KM_1")
    settings = {"root": str(tmp_path), "layout": "whu", "disparity_range": [-8, 8]}
    dataset = StereoDataset.of("mine", settings)
    assert len(dataset.pairs("train", labelled=True)) == 1
    with pytest.raises(InputError):
        dataset.pairs("test", labelled=True)
    with pytest.raises(InputError):
        StereoDataset.of("mine", settings | {"disparity_range": [8, 8]})


@needs_published
def test_the_published_pairs_are_found():
    first, second = find_pairs(PUBLISHED / "us3d", "us3d")
    assert (first.city, first.split, second.name) == ("Jacksonville", "test", "JAX_264_014_007")
    assert read_image(first.left).shape == (1024, 1024, 3)
    labels = read_disparity(first.disparity)
    assert 0.1 < np.isnan(labels).mean() < 0.3 and np.nanmin(labels) > -96
    (pair,) = find_pairs(PUBLISHED / "whu", "whu")
    assert (pair.name, pair.city, pair.disparity) == ("KM_253", "Kunming", None)


@pytest.mark.parametrize("bands", [1, 3])
def test_samples_follow_the_conventions_of_torchgeo(tmp_path, bands):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    folder = tmp_path / "with ground truth/train"
    shape = (4, 6) if bands == 1 else (4, 6, 3)
    left = np.arange(np.prod(shape), dtype=np.uint16).reshape(shape) + 40_000
    labels = np.full((4, 6), -3.5, np.float32)
    labels[1, 2] = -999
    for kind, values in (("left", left), ("right", left + 1), ("disparity", labels)):
        place = folder / ("disp" if kind == "disparity" else kind)
        write(place / f"KM_{kind}_1.tiff", values)
    tiles = StereoTiles(tmp_path, "train", lambda sample: sample | {"seen": True})
    began = time.monotonic()
    (sample,) = torch.utils.data.DataLoader(tiles, batch_size=None)
    assert time.monotonic() - began < 2.0 and len(tiles) == 1 and sample["seen"]
    assert sample["image"].dtype == sample["disparity"].dtype == torch.float32
    assert sample["image"].shape == (2, bands, 4, 6) and sample["mask"].dtype == torch.bool
    wanted = left[None] if bands == 1 else np.moveaxis(left, -1, 0)
    np.testing.assert_array_equal(sample["image"][0], wanted)
    assert torch.equal(sample["mask"], torch.from_numpy(labels != -999))
    known = sample["mask"].numpy()
    assert sample["disparity"].numpy()[known].tobytes() == labels[known].tobytes()
    assert np.isnan(sample["disparity"][1, 2])
