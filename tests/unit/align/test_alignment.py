"""The alignment of a pair as JSON."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest

from stereotruth.align.align import write_alignment
from stereotruth.align.alignment import Alignment
from stereotruth.align.figures import draw_residuals
from stereotruth.core.errors import InputError

from ...synthetic.surveyed_pair import make_gcps, run


def test_json_keeps_everything(images, tmp_path):
    rows = make_gcps(10)
    rows[2]["left_col"] += 20.0
    rows[3]["right_col"] = rows[3]["right_row"] = ""
    result = run(images, tmp_path, rows)
    paths = [tmp_path / f"residuals.{ext}" for ext in ("json", "csv", "png")]
    write_alignment(result, *paths[:2])
    again = Alignment.read(paths[0])
    draw_residuals(again, paths[2])
    assert again.to_dict() == result.to_dict()
    assert np.array_equal(again.left.packed(), result.left.packed())
    heights = [row["height"] for row in rows]  # each is used in one view at least
    assert again.reference_height == pytest.approx(np.mean(heights), abs=1e-3)
    assert json.loads(paths[0].read_text())["left"]["left_out"] == ["G03"]
    with paths[1].open() as stream:
        table = list(csv.DictReader(stream))
    assert len(table) == 19
    assert [row["id"] for row in table if row["used"] == "no"] == ["G03"]
    assert abs(float(table[0]["before_col_px"])) > 3 > abs(float(table[0]["after_col_px"]))
    assert cv2.imread(str(paths[2])).shape[0] > 800
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        ["gcps.csv", *(p.name for p in paths)]
    )


def test_an_edited_alignment_is_used_as_it_is_and_told(images, tmp_path, caplog):
    """A user moves an alignment by hand and names the copy in ``alignment.fixed``."""
    file = tmp_path / "alignment.json"
    run(images, tmp_path, make_gcps(10)).save(file)
    Alignment.read(file)
    assert not caplog.records
    values = json.loads(file.read_text())
    values["right"]["affine"][0][2] += 0.15
    file.write_text(json.dumps(values))
    moved = Alignment.read(file)
    assert moved.right_fit.affine[0][2] == values["right"]["affine"][0][2]
    assert "alignment.json: edited since it was made" in caplog.text


def test_alignments_that_are_none_are_refused(tmp_path):
    (tmp_path / "x.json").write_text("{}")
    for name in ("none.json", "x.json"):
        with pytest.raises(InputError) as caught:
            Alignment.read(tmp_path / name)
        assert name in str(caught.value) and "Remedy: " in str(caught.value)
