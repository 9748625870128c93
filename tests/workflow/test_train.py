"""Networks through the workflow: trained, fine-tuned on another dataset, scored, and left alone."""

from __future__ import annotations

import json
import shutil

import pytest
import yaml

pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")

from ..synthetic.project import Project, copy_project
from ..synthetic.small_pairs import RANGE, small_dataset

TRAINING = {"epochs": 1, "crop_px": [32, 64], "device": "cpu"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Methods first (from scratch) and second (from first's weights on another dataset)."""
    dataset = small_dataset(tmp_path_factory.mktemp("pairs"))
    project = copy_project(tmp_path_factory.mktemp("made") / "project")
    for name in ("one", "two"):
        shutil.copytree(dataset.root, project.folder / name)
        shutil.copytree(project.folder / name / "val", project.folder / name / "test")
    settings = {"layout": "whu", "disparity_range": list(RANGE)}
    datasets = {name: {"root": name, **settings} for name in ("one", "two")}
    second = {"initial_weights": "results/train/one/first/best.pt", "frozen": ["features"]}
    methods = {
        "first": {"kind": "stereonet"},
        "second": {"kind": "stereonet", "fine_tuned_of": "first", "training": second},
        "sgm": {"kind": "sgm"},
    }
    config = {"benchmark": {"datasets": datasets, "methods": methods}, "training": TRAINING}
    (project.folder / "my.yaml").write_text(yaml.safe_dump(config))
    run = project.snakemake(*TARGETS)
    assert run.status == 0, run.text[-4000:]
    return project


TARGETS = ("benchmark/one/first", "benchmark/two/second", "--configfile", "my.yaml")


def summary(project: Project, dataset: str, method: str) -> dict:
    file = project.folder / f"results/train/{dataset}/{method}/training.json"
    return json.loads(file.read_text())


def test_networks_are_trained_and_scored(made: Project) -> None:
    first, second = summary(made, "one", "first"), summary(made, "two", "second")
    assert first["model"]["disparity_range"] == list(RANGE)
    assert (first["epochs"], second["epochs"]) == (1, 1)
    assert second["training"]["frozen"] == ["features"]
    for target in ("benchmark/one/first", "benchmark/two/second"):
        assert (made.folder / target / "scores.json").is_file()


def test_nothing_is_done_twice_and_a_setting_of_one_method_reruns_it_alone(made: Project) -> None:
    assert made.plan(*TARGETS) == {}
    text = (made.folder / "my.yaml").read_text()
    config = yaml.safe_load(text)
    config["benchmark"]["methods"]["second"]["training"]["learning_rate"] = 1e-4
    try:
        (made.folder / "my.yaml").write_text(yaml.safe_dump(config))
        assert made.plan(*TARGETS) == {"train": 1, "match": 1, "score": 1}
    finally:
        (made.folder / "my.yaml").write_text(text)


def test_mistakes_end_with_one_line(made: Project) -> None:
    run = made.snakemake("results/train/one/sgm/best.pt", "--configfile", "my.yaml")
    assert run.status != 0
    assert "method 'sgm' is of kind 'sgm', which is not trained" in run.text
    (made.folder / "bad.yaml").write_text("training: {crop_px: [30, 64]}\n")
    run = made.snakemake("results/train/two/first/best.pt", "--configfile", "my.yaml", "bad.yaml")
    assert run.status != 0 and "no multiples of 8 px" in run.text
    run = made.refuse("benchmark/one/none", "--configfile", "my.yaml")
    assert "no method 'none'" in run.text
