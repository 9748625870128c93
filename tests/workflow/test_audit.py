"""The audit of a dataset through the workflow: its own, and one that a configuration names."""

from __future__ import annotations

import csv
import json
import shutil

import pytest

ARGUMENTS = ["--configfile", "tiny.yaml", "later.yaml"]


def summary(project, dataset):
    return json.loads((project.folder / f"audit/{dataset}/summary.json").read_text())


def test_the_workflow_s_own_dataset_has_no_faults(tiled, later):
    assert tiled.plan("audit/synthetic", *ARGUMENTS) == {"dataset": 1, "audit": 1}
    found = summary(later, "synthetic")
    assert found["pairs"] >= 4 and found["labelled_pairs"] >= 4
    assert found["verdicts"]["fault"] == 0, found["statements"]
    assert abs(found["pooled"]["label_bias_px"]["median"]) < 0.1


@pytest.mark.slow
def test_a_limit_judges_again_and_a_changed_dataset_is_audited(later, tmp_path):
    audited = later.copy(tmp_path / "audited")
    (audited.folder / "limit.yaml").write_text("audit: {parallax_px: 0.2}\n")
    assert audited.plan("audit/synthetic", *ARGUMENTS, "limit.yaml") == {"audit": 1}
    faulty = audited.folder / "faulty"
    shutil.rmtree(faulty)
    shutil.copytree(audited.folder / "dataset", faulty)
    with (faulty / "manifest.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["disp"]][:2]  # seconds each
    with (faulty / "manifest.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    shutil.copyfile(faulty / rows[0]["left"], faulty / rows[0]["right"])
    run = audited.snakemake("audit/faulty", *ARGUMENTS)
    assert run.status == 0, run.text[-4000:]
    with (audited.folder / "audit/faulty/pairs.csv").open(newline="") as stream:
        faults = {row["pair"]: row["faults"] for row in csv.DictReader(stream) if row["faults"]}
    assert faults == {rows[0]["tile"]: "left and right image are the same"}
