"""Manifests of others: each name, path and number in them is held to what it may be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.tiles.layouts import assemble_dataset, write_layout
from stereotruth.tiles.manifest import labelled_tiles, read_manifest
from stereotruth.tiles.splits import shared_ground
from stereotruth.tiles.stereo_dataset import find_pairs
from stereotruth.tiles.verify import verify

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
GOOD = {
    "tile": "QC_1",
    "city": "Qichun",
    "scene": "Qichun-1",
    "row0": "0",
    "col0": "0",
    "size": "8",
    "right_offset_px": "-3",
    "complete": "yes",
    "split": "test",
    "left": "left/QC_left_1.tiff",
    "right": "right/QC_right_1.tiff",
    "disp": "disp/QC_disparity_1.tiff",
    "disp_sha256": "0",
    "orientation": "orientation/QC_1.json",
    "orientation_sha256": "0",
}
WAYS = {
    "pairs": lambda folder: find_pairs(folder, "stereotruth"),
    "manifest": read_manifest,
    "tiles": lambda folder: labelled_tiles(folder, "Qichun-1"),
    "splits": lambda folder: shared_ground(folder / "manifest.csv"),
    "verify": lambda folder: verify([folder]),
    "dataset": lambda folder: assemble_dataset([folder], folder.parent / "dataset"),
    "layout": lambda folder: write_layout(folder, folder.parent / "kitti", "kitti"),
}


def folder_of(tmp_path: Path, **cells: str) -> Path:
    """A dataset of one pair with some cells other than they should be."""
    folder = tmp_path / "given"
    for name in ("left", "right", "disp"):
        write(folder / GOOD[name], np.ones((8, 8), np.uint16))
    write_table(folder / "manifest.csv", [GOOD | cells])
    return folder


def test_a_good_manifest_is_read(tmp_path):
    folder = folder_of(tmp_path)
    assert read_manifest(folder) == [GOOD]
    assert [pair.name for pair in find_pairs(folder, "stereotruth")] == ["QC_1"]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "cells",
    [
        {"tile": "../../../../x"},
        {"tile": ""},
        {"city": "../up"},
        {"left": "../../secret.tiff"},
        {"orientation": "../x.json"},
    ],
    ids=lambda cells: "{}-{:.8}".format(*next(iter(cells.items()))),
)
def test_names_that_lead_elsewhere_are_refused_wherever_a_manifest_is_read(tmp_path, way, cells):
    folder = folder_of(tmp_path, **cells)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"manifest\.csv: line 2: "):
        WAYS[way](folder)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("cells", [{"row0": "1e99"}, {"size": "a"}, {"split": "tset"}])
def test_values_that_are_none_are_refused(tmp_path, cells):
    with pytest.raises(InputError, match="line 2: "):
        read_manifest(folder_of(tmp_path, **cells))


@pytest.mark.parametrize("text", [b"\xff\xfe", b"tile,left\nQC_1\n", b'tile\n"' + b"x" * 200_000])
def test_what_is_no_table_is_refused(tmp_path, text):
    (tmp_path / "manifest.csv").write_bytes(text)
    with pytest.raises(InputError):
        read_manifest(tmp_path)
