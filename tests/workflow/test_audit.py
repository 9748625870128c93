"""The audit of a dataset through the workflow: its own, and one that a configuration names."""

from __future__ import annotations

import json

ARGUMENTS = ["--configfile", "tiny.yaml", "later.yaml"]


def summary(project, dataset):
    return json.loads((project.folder / f"audit/{dataset}/summary.json").read_text())


def test_the_workflow_s_own_dataset_has_no_faults(tiled, later):
    assert tiled.plan("audit/synthetic", *ARGUMENTS) == {"dataset": 1, "audit": 1}
    found = summary(later, "synthetic")
    assert found["pairs"] >= 4 and found["labelled_pairs"] >= 4
    assert found["verdicts"]["fault"] == 0, found["statements"]
    assert abs(found["pooled"]["label_bias_px"]["median"]) < 0.1
