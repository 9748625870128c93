"""The dataset as Croissant, loaded by mlcroissant."""

from __future__ import annotations

import sys
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

mlc = pytest.importorskip("mlcroissant", reason="the extra catalog is not installed")

from stereotruth.core.errors import InputError
from stereotruth.tiles.published_layout import assemble_dataset
from stereotruth.tiles.verify import defects

from ...synthetic.tiled_scene import read, rows_of


def test_the_pairs_are_loaded(exported, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    assemble_dataset([exported[0]], folder, catalogs=["croissant"])
    assert defects(folder) == []
    dataset = mlc.Dataset(jsonld=str(folder / "croissant.json"))
    assert not dataset.metadata.issues.errors
    pairs = [
        {key.partition("/")[2]: value for key, value in one.items()}
        for one in dataset.records("pairs")
    ]
    rows = rows_of(folder)
    assert [one["tile"].decode() for one in pairs] == [row["tile"] for row in rows]
    for one, row in zip(pairs, rows):
        assert one["split"].decode() == row["split"]
        assert one["right_offset_px"] == int(row["right_offset_px"])
        assert (one["disp"] is None) == (row["disp"] == "")
        for kind in ("left", "right", *(("disp",) if row["disp"] else ())):
            with Image.open(folder / one[kind].decode()) as image:
                np.testing.assert_array_equal(np.asarray(image), read(folder / row[kind]))
    sets = {one.id: one.includes for one in dataset.metadata.distribution if one.id != "manifest"}
    files = [p.relative_to(folder).as_posix() for p in folder.rglob("*.tiff")]
    for kind, column in (("left", "left"), ("right", "right"), ("disparity", "disp")):
        found = [f for f in files if any(fnmatch(f, one) for one in sets[f"{kind}-files"])]
        assert sorted(found) == sorted(row[column] for row in rows if row[column])


def test_without_the_extra_it_is_said_how_to_get_it(exported, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mlcroissant", None)
    monkeypatch.delitem(sys.modules, "stereotruth.tiles.croissant", raising=False)
    monkeypatch.delattr("stereotruth.tiles.croissant", raising=False)
    with pytest.raises(InputError, match=r"croissant needs mlcroissant.*the extra catalog"):
        assemble_dataset([exported[0]], tmp_path / "out", catalogs=["croissant"])
    assert not (tmp_path / "out").exists()
