"""The folder of scores of a method."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stereobench.scores.predictions import predict
from stereobench.scores.score_method import describe, score
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.images import write
from ...synthetic.toy_benchmark import CITIES, PLAN, SHAPE, rows

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_a_folder_of_scores_holds_tiles_cities_strata_and_pictures(compared):
    folder = compared / "benchmark/half"
    tiles = rows(folder / "scores.csv")
    assert [row["tile"] for row in tiles] == [f"{c}_{n}" for c in CITIES for n in (1, 2, 3)]
    for row in tiles:
        assert int(row["labelled"]) == 24 * 28 and float(row["valid_share"]) == 0.75
        assert float(row["epe_px"]) == pytest.approx(0.5, abs=1e-5)
        assert float(row["filled_epe_px"]) > 0.5
    kunming, wuhan, total = rows(folder / "cities.csv")
    assert (kunming["city"], wuhan["city"], total["city"]) == ("Kunming", "Wuhan", "all")
    assert int(total["labelled"]) == 6 * 24 * 28 and total["tiles"] == "6"
    assert [float(of["median_px"]) for of in (kunming, wuhan, total)] == [0.5] * 3
    assert kunming["epe_px_low"] == ""  # three tiles are too few
    low, mean, high = (float(total[f"filled_epe_px{end}"]) for end in ("_low", "", "_high"))
    assert low < mean < high
    names = [row["stratum"] for row in rows(folder / "strata.csv")]
    assert names == ["all", "near_step", "match_inside", "match_outside"]
    assert sorted(p.name for p in (folder / "panels").iterdir()) == ["KM_2.png", "WH_2.png"]
    summary = json.loads((folder / "scores.json").read_text())
    assert summary["label"] == "Half" and summary["tiles"] == 6
    assert "of the 75.0 % of pixels that are valid; holes filled: EPE" in describe(summary)


def test_scoring_again_gives_the_same_bytes(compared, tmp_path):
    dataset = StereoDataset("toy", compared / "data", "whu", (-8, 8))
    half = compared / "match/half"
    score(dataset, "test", "Half", half, tmp_path / "again", PLAN, fine_tuned_of="two")
    files = [p for p in (compared / "benchmark/half").rglob("*") if p.is_file()]
    assert len(files) == 7
    for file in files:
        other = tmp_path / "again" / file.relative_to(compared / "benchmark/half")
        assert file.read_bytes() == other.read_bytes(), file.name


def test_stated_uncertainties_are_held_against_the_errors(compared, tmp_path):
    dataset = StereoDataset("toy", compared / "data", "whu", (-8, 8))
    rng = np.random.default_rng(3)
    for pair in dataset.pairs("test"):
        error = rng.normal(0, 1, SHAPE).astype(np.float32)
        write(tmp_path / f"theirs/{pair.name}.tif", dataset.labels(pair) + error)
        write(tmp_path / f"theirs/{pair.name}_uncertainty.tif", np.abs(error))
    entry = {"kind": "folder", "folder": str(tmp_path / "theirs")}
    predict(dataset, "test", "sure", entry, tmp_path / "match", work=tmp_path / "work")
    summary = score(dataset, "test", "Sure", tmp_path / "match", tmp_path / "out", PLAN)
    found = {row["stratum"]: row for row in summary["confidence"]}
    assert list(found) == ["all", "near_step", "match_inside", "match_outside"]
    assert found["all"]["pixels"] == summary["all"]["labelled"]
    assert found["match_inside"]["pixels"] < found["all"]["pixels"]
    assert found["all"]["epe_px"] == pytest.approx(summary["all"]["epe_px"], abs=1e-6)
    assert abs(found["all"]["ause_px"]) < 1e-4 and found["all"]["ause_random_px"] > 0.1
    assert found["all"]["interval_50_percent_coverage_share"] < 0.01  # errors of all but one sigma
    curve = [row for row in rows(tmp_path / "out/sparsification.csv") if row["stratum"] == "all"]
    epe = [float(row["epe_px"]) for row in curve]
    assert epe[0] == pytest.approx(summary["all"]["epe_px"], abs=1e-6)
    assert epe == sorted(epe, reverse=True) and epe[-1] < 0.02
    none = json.loads((compared / "benchmark/half/scores.json").read_text())
    assert none["confidence"] == []
    assert not (compared / "benchmark/half/sparsification.csv").exists()


def test_layers_of_the_tiles_are_strata_of_the_scores(compared, tmp_path):
    """Errors of high things by their layer agl, and of all others."""
    (pair, *_) = StereoDataset("toy", compared / "data", "whu", (-8, 8)).pairs("test")
    labels, high = StereoDataset("toy", compared / "data", "whu", (-8, 8)).labels(pair), 20.0
    agl = np.full(SHAPE, -9999, np.float32)
    agl[:, :10], agl[:, 10:] = 0.5, high
    root = tmp_path / "data"
    write(root / "agl.tif", agl, nodata=-9999)
    for name, file in (("left", pair.left), ("right", pair.right), ("disp", pair.disparity)):
        (root / f"{name}.tif").write_bytes(file.read_bytes())
    columns = {"tile": pair.name, "city": "Town", "split": "test", "layer_agl": "agl.tif"}
    columns |= {name: f"{name}.tif" for name in ("left", "right", "disp")}
    (root / "manifest.csv").write_text(f"{','.join(columns)}\n{','.join(columns.values())}\n")
    dataset = StereoDataset("toy", root, "stereotruth", (-8, 8))
    found = np.where(agl == high, labels + 2, labels + np.float32(0.25))
    write(tmp_path / f"theirs/{pair.name}.tif", found)
    entry = {"kind": "folder", "folder": str(tmp_path / "theirs")}
    predict(dataset, "test", "t", entry, tmp_path / "match", work=tmp_path / "work")
    summary = score(dataset, "test", "T", tmp_path / "match", tmp_path / "scores", PLAN)
    epe = {row["stratum"]: row["epe_px"] for row in summary["strata"]}
    assert epe["agl_below_2_m"] == pytest.approx(0.25, abs=1e-5)
    assert epe["agl_10_to_30_m"] == pytest.approx(2.0, abs=1e-5)
    assert "agl_2_to_10_m" not in epe and not any(name.startswith("unc") for name in epe)
