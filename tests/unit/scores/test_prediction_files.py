"""Packed results: scored elsewhere to the same numbers, or refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from stereobench.scores.prediction_files import FILE, pack
from stereobench.scores.predictions import predict
from stereobench.scores.score_method import score
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import write_disparity
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.toy_benchmark import PLAN

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture
def packed(compared, tmp_path):
    out = tmp_path / "submission"
    pack(compared / "match/half", compared / "benchmark/half", out)
    return out


def scored(compared, tmp_path, packed, **more):
    """As another machine has it: the dataset copied elsewhere, other samples for the intervals."""
    root = tmp_path / "elsewhere"
    if not root.exists():
        shutil.copytree(compared / "data", root)
    dataset = StereoDataset("theirs", root, "whu", (-8, 8))
    entry = {"kind": "folder", "folder": str(packed)}
    predict(dataset, "test", "sent", entry, tmp_path / "match", work=tmp_path / "work")
    plan = replace(PLAN, seed=9, **more)
    return score(dataset, "test", "Sent", tmp_path / "match", tmp_path / "out", plan)


def test_another_machine_has_the_same_numbers(compared, tmp_path, packed):
    here = json.loads((compared / "benchmark/half/scores.json").read_text())
    there = scored(compared, tmp_path, packed)
    assert there["protocol"]["id"] == here["protocol"]["id"]
    for key in ("epe_px", "filled_epe_px", "filled_d1_3_px_share", "valid_share", "median_px"):
        assert there["all"][key] == here["all"][key]
    assert "submitted" not in there
    told = json.loads((packed / FILE).read_text())
    assert told["scores"]["all"] == here["all"] and told["machine"] == here["machine"]
    assert set(told["files"]) == {file.name for file in packed.iterdir()} - {FILE}


def test_a_file_that_was_changed_is_refused(compared, tmp_path, packed):
    file = packed / "KM_2.tif"
    write_disparity(file, np.zeros((24, 32), np.float32))
    with pytest.raises(InputError, match="not as it was submitted"):
        scored(compared, tmp_path, packed)


def test_scores_that_were_made_better_are_refused(compared, tmp_path, packed):
    told = json.loads((packed / FILE).read_text())
    told["scores"]["cities"][1]["filled_epe_px"] -= 0.01
    (packed / FILE).write_text(json.dumps(told))
    with pytest.raises(InputError, match=r"filled_epe_px of Wuhan is .*, submitted as"):
        scored(compared, tmp_path, packed)


def test_another_protocol_or_other_labels_are_refused(compared, tmp_path, packed):
    with pytest.raises(InputError, match=r"submitted by protocol own-.*, scored by own-"):
        scored(compared, tmp_path, packed, thresholds_px=[2, 1])
    label = tmp_path / "elsewhere/test/disp/KM_disparity_1.tiff"
    shutil.copyfile(label.with_name("KM_disparity_2.tiff"), label)
    with pytest.raises(InputError, match=r"submitted by protocol own-.*, scored by own-"):
        scored(compared, tmp_path, packed)


def test_uncertainties_go_along_and_a_spoilt_submission_is_named(compared, tmp_path, packed):
    (packed / FILE).write_text("{}")
    with pytest.raises(InputError, match="no submission"):
        scored(compared, tmp_path, packed)
    match = tmp_path / "with"
    shutil.copytree(compared / "match/half", match)
    (match / "uncertainty").mkdir()
    for file in match.glob("*.tiff"):
        shutil.copyfile(file, match / "uncertainty" / file.name)
    pack(match, compared / "benchmark/half", tmp_path / "two")
    assert len(list((tmp_path / "two").glob("*_uncertainty.tif"))) == 6


@pytest.mark.parametrize(
    ("place", "value"),
    [("files", "../../x.tif"), ("protocol", "../x")],
)
def test_a_submission_names_no_other_place(compared, tmp_path, packed, place, value):
    told = json.loads((packed / FILE).read_text())
    if place == "files":
        told["files"][value] = "0"
    else:
        told["scores"]["protocol"]["id"] = value
    (packed / FILE).write_text(json.dumps(told))
    with pytest.raises(InputError, match=r"submission\.json: the (name of a result|protocol)"):
        scored(compared, tmp_path, packed)
