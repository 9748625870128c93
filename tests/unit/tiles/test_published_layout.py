"""Putting tiles folders together; on hand-made folders, since only files and manifests matter."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.tiles.published_layout import assemble_dataset
from stereotruth.tiles.verify import defects

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
    text = (out / "README.txt").read_text()
    for words in ("x_left - x_right", "-999", "right_offset_px", "0.0150 px", "4 pairs"):
        assert words in text
    # A copy: an edit leaves the tiles alone.
    (out / names[0]).write_text("edited")
    assert defects(cities[0]) == [] and defects(cities[1]) == []
    assert len(defects(out)) == 1
    assemble_dataset(cities, out)  # replaces what was there
    assert defects(out) == []


def test_refusals(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
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
