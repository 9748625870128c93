"""The dataset on hand-made folders, whose files matter alone; other layouts, by several readers."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.core.products.rasters import read_disparity, read_image
from stereotruth.tiles.layouts import assemble_dataset, write_layout
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereotruth.tiles.verify import defects

from ...synthetic.images import write
from ...synthetic.other_programs import PROGRAMS
from ...synthetic.tiled_scene import SIZE, labels, make_scene, rows_of, run

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SPLITS = ["train", "train", "val", "test", "none", "unlabelled"]


def make_city(folder: Path, prefix: str, *, east: float = 0.0) -> Path:
    """A tiles folder with the six tiles of SPLITS, side by side on the ground."""
    rows = []
    for n, split in enumerate(SPLITS):
        complete = split != "unlabelled"
        group = "" if complete else "unlabelled/"
        ring = [
            [115 + east + (n + a) * 0.01, 30 + b * 0.01]
            for a, b in ((0, 1), (1, 1), (1, 0), (0, 0))
        ]
        files = {
            "left": f"{group}left/{prefix}_left_{n}.tiff",
            "right": f"{group}right/{prefix}_right_{n}.tiff",
            "disp": f"disp/{prefix}_disparity_{n}.tiff" if complete else "",
            "orientation": f"orientation/{prefix}_{n}.json",
        }
        row = {
            "tile": f"{prefix}_{n}",
            "city": prefix,
            "scene": prefix,
            "row0": 0,
            "col0": 64 * n,
            "size": 64,
            "right_offset_px": 0,
            "complete": "yes" if complete else "no",
            "split": split if complete else "none",
            "disparity_rounding_px": "0.0150" if complete else "",
            "disparity_nodata": "-999",
        }
        for kind, name in files.items():
            row[kind], row[f"{kind}_sha256"] = name, ""
            if name:
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                text = {"footprint": {"coordinates": [[*ring, ring[0]]]}}
                path.write_text(
                    json.dumps(text) if kind == "orientation" else f"{name} of {folder}"
                )
                row[f"{kind}_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        rows.append(row)
    write_table(folder / "manifest.csv", rows)
    return folder


def test_published_layout(tmp_path: Path) -> None:
    cities = [make_city(tmp_path / "A", "AA"), make_city(tmp_path / "B", "BB", east=1.0)]
    out = tmp_path / "dataset"
    summary = assemble_dataset(cities, out)
    assert summary["shared_ground"] == []
    assert summary["pairs"] == {
        "with ground truth/train": 4,
        "with ground truth/val": 2,
        "with ground truth/test": 2,
        "without ground truth": 2,
    }
    names = sorted(p.relative_to(out).as_posix() for p in out.rglob("*.tiff"))
    assert len(names) == 8 * 3 + 2 * 2
    assert "with ground truth/train/disp/AA_disparity_0.tiff" in names
    assert "with ground truth/val/right/BB_right_2.tiff" in names
    assert "without ground truth/left/AA_left_5.tiff" in names
    assert not any("_4." in name for name in names)  # split none stays behind
    assert defects(out) == []
    with (out / "manifest.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 10 and "orientation" not in rows[0]
    assert "0.0150 px" in (out / "README.txt").read_text()
    # A copy: an edit leaves the tiles alone.
    (out / names[0]).write_text("edited")
    assert defects(cities[0]) == [] and defects(cities[1]) == []
    assert len(defects(out)) == 1
    assemble_dataset(cities, out)  # replaces what was there
    assert defects(out) == []


def test_refusals(tmp_path: Path) -> None:
    city = make_city(tmp_path / "A", "AA")
    with pytest.raises(InputError, match="AA_0 is in"):
        assemble_dataset([city, make_city(tmp_path / "B", "AA")], tmp_path / "d")
    with pytest.raises(InputError, match="no manifest"):
        assemble_dataset([tmp_path / "nowhere"], tmp_path / "d")
    (city / "right" / "AA_right_1.tiff").write_text("edited")
    with pytest.raises(InputError, match=r"AA_right_1.*not as in its manifest"):
        assemble_dataset([city], tmp_path / "d")
    assert not (tmp_path / "d").exists() and not list(tmp_path.glob("*.partial"))


def test_cities_that_share_ground_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cities = [make_city(tmp_path / "A", "AA"), make_city(tmp_path / "B", "BB", east=0.02)]
    shared = assemble_dataset(cities, tmp_path / "dataset")["shared_ground"]
    assert ("AA_2", "BB_0") in shared and ("AA_3", "BB_1") in shared and len(shared) == 2
    assert "AA_2 and BB_0 share ground" in caplog.text


# ------------------------------------------------------------------ other layouts


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


@pytest.fixture(scope="module", params=["kitti-grey", "us3d-colour"])
def written(request, datasets, tmp_path_factory) -> tuple[str, Path, Path]:
    layout, kind = request.param.split("-")
    out = tmp_path_factory.mktemp("layout") / layout
    assert write_layout(datasets[kind], out, layout) >= 10
    assert defects(out) == []
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
