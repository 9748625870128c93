"""Stereo methods through the workflow: SGM, a user's function and a folder of results."""

from __future__ import annotations

import csv
import json
import shutil

import cv2
import numpy as np
import pytest
import yaml

ARGUMENTS = ["--configfile", "tiny.yaml", "later.yaml"]


def scores(project, method):
    return json.loads((project.folder / f"benchmark/synthetic/{method}/scores.json").read_text())


def test_sgm_is_scored_on_the_workflow_s_own_dataset(tiled, later):
    jobs = tiled.plan("benchmark/synthetic/sgm", *ARGUMENTS)
    assert jobs == {"dataset": 1, "match": 1, "score": 1}
    scored = later
    found = scores(scored, "sgm")
    assert found["label"] == "SGM" and found["tiles"] >= 4
    assert found["all"]["epe_px"] < 1 and found["all"]["valid_share"] > 0.7
    assert {"all", "near_step", "near_occlusion", "ground", "building"} <= {
        row["stratum"] for row in found["strata"]
    }
    with (scored.folder / "dataset/manifest.csv").open(newline="") as stream:
        labelled = [row["tile"] for row in csv.DictReader(stream) if row["disp"]]
    predictions = scored.folder / "results/match/synthetic/sgm"
    assert {file.stem for file in predictions.glob("*.tiff")} >= set(labelled)


def test_a_threshold_or_the_seed_scores_again_but_matches_nothing(later, tmp_path):
    scored = later.copy(tmp_path / "scored")
    for change in ("{thresholds_px: [2]}", "{bootstrap: 7}"):
        (scored.folder / "changed.yaml").write_text(f"benchmark: {change}\n")
        jobs = scored.plan("benchmark/synthetic/sgm", *ARGUMENTS, "changed.yaml")
        assert jobs == {"score": 1}, change
    (scored.folder / "changed.yaml").write_text("benchmark: {methods: {sgm: {block_size: 5}}}\n")
    jobs = scored.plan("benchmark/synthetic/sgm", *ARGUMENTS, "changed.yaml")
    assert jobs == {"match": 1, "score": 1}


OWN = "benchmark: {datasets: {faulty: null}}\n"


@pytest.mark.slow
def test_a_user_s_function_and_results_are_compared_with_sgm(later, tmp_path):
    """The results in the folder are SGM's as they are submitted, so that scores are the same."""
    scored = later.copy(tmp_path / "scored")
    submission = scored.folder / "submission/synthetic/sgm"
    assert (submission / "submission.json").is_file()
    shutil.copytree(submission, scored.folder / "theirs", dirs_exist_ok=True)
    own = [*ARGUMENTS, "own.yaml"]
    (scored.folder / "own.yaml").write_text(OWN)
    run = scored.snakemake("benchmark", *own)
    assert run.status == 0, run.text[-4000:]
    assert run.jobs == {"match": 2, "score": 2, "benchmark_tables": 1, "benchmark": 1}
    assert scores(scored, "theirs")["all"] == scores(scored, "sgm")["all"]
    assert scores(scored, "mine")["all"]["epe_px"] < 2
    folder = scored.folder / "benchmark/synthetic"
    with (folder / "methods.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["method"] for row in rows] == ["SGM", "mine", "Theirs"]
    assert rows[0]["median_seconds"] and not rows[2]["median_seconds"]
    (protocol,) = {row["protocol"] for row in rows}
    assert protocol == scores(scored, "theirs")["protocol"]["id"]
    picture = cv2.imread(str(folder / "figure10.png"))
    assert picture.shape[0] > 128 and picture.shape[1] > 5 * 128  # images and three methods
    assert picture.std() > 30 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000
    assert "Theirs" in (folder / "index.html").read_text()
    assert scored.plan("benchmark", *own) == {}
    with (scored.folder / "mine.py").open("a") as stream:
        stream.write("\n# another\n")
    jobs = scored.plan("benchmark", *own)
    assert jobs == {"match": 1, "score": 1, "benchmark_tables": 1, "benchmark": 1}


def test_a_wrong_name_ends_before_any_work(project):
    far = {"root": "/nowhere", "layout": "us3d", "disparity_range": [-96, 96]}
    config = {"benchmark": {"datasets": {"far": far}}}
    (project.folder / "far.yaml").write_text(yaml.safe_dump(config))
    for target, words in (
        ("benchmark/nothing/sgm", "no dataset 'nothing'"),
        ("benchmark/synthetic/raft", "no method 'raft'"),
        ("benchmark/far/sgm", "no such folder"),
        ("audit/nothing", "no dataset 'nothing'"),
    ):
        run = project.snakemake("--dry-run", target, "--configfile", "far.yaml")
        *_, heading, message = run.text.rstrip().splitlines()
        assert run.status != 0 and heading == "Refused:" and words in message


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"kind": "function", "function": "own.py:macth"}, "'match'"),
        ({"kind": "command", "command": "no_such_program {left} {right} {out}"}, "no_such_program"),
    ],
)
def test_a_method_that_is_not_there_ends_before_any_work(project, entry, words):
    (project.folder / "own.py").write_text("def match(left, right, disparity_range): pass\n")
    config = {"datasets": {"synthetic": {"methods": ["sgm", "own"]}}, "methods": {"own": entry}}
    (project.folder / "wrong.yaml").write_text(yaml.safe_dump({"benchmark": config}))
    run = project.snakemake("--dry-run", "benchmark", "--configfile", "wrong.yaml")
    *_, heading, message = run.text.rstrip().splitlines()
    assert run.status != 0 and heading == "Refused:" and words in message
