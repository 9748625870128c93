"""What a run can make, and typos of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.errors import InputError
from stereotruth.project.check import check_project
from stereotruth.project.project import FILES
from stereotruth.project.run_workflow import (
    TARGETS,
    list_targets,
    need_scenes,
    refuse_unknown,
    rules,
    run_workflow,
)
from stereotruth.project.status import show_status


def test_targets_are_listed_with_the_names_of_the_project(folder):
    lines = list_targets()
    assert [line.split()[0] for line in lines[: len(TARGETS)]] == list(TARGETS)
    assert "<City>: Good" in lines and "<scene>: Good-1" in lines


def test_each_plain_target_is_a_rule():
    plain = {target for target in TARGETS if re.fullmatch(r"\w+", target)}
    assert plain <= set(rules())


def test_each_path_is_what_a_rule_makes():
    rules_text = "".join(
        file.read_text(encoding="utf-8")
        for file in sorted((FILES / "workflow" / "rules").glob("*.smk"))
    )
    for target in TARGETS:
        path = re.sub(r"<(\w+)>", lambda found: f"{{{found[1].lower()}}}", target)
        assert "/" not in path or f'"{path}"' in rules_text, target


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("reprot", "report"),
        ("tiles/Goood", "tiles/Good"),
        ("datasets", "dataset"),
        ("results/report/Goood/index.html", "results/report/Good/index.html"),
        ("benchmark/syntetic/sgm", "benchmark/synthetic/sgm"),
    ],
)
def test_a_typo_is_told_with_what_it_may_mean(folder, word, meant):
    with pytest.raises(InputError, match=f"{word}: no such target.*did you mean {meant}"):
        refuse_unknown([word, "--cores", "2"])


def test_what_snakemake_knows_is_left_to_it(folder):
    refuse_unknown(["report", "tiles/Good", "results/x.json", "--forcerun", "anything"])
    refuse_unknown(["results/closure/Good.json", "results/training_cities/cities/1"])


def test_built_in_datasets_are_there_unless_others_are_named():
    def named(datasets):
        settings = Configuration.of({"benchmark": {"datasets": datasets}})
        return [name for name, entry in settings.benchmark.datasets.items() if entry]

    mine = {"root": "d", "layout": "whu", "disparity_range": [-64, 64]}
    assert named({}) == ["synthetic"]
    assert named({"mine": mine}) == ["mine"]
    assert sorted(named({"mine": mine, "synthetic": {}})) == ["mine", "synthetic"]


def test_a_folder_without_a_sheet_of_scenes_has_no_built_in_cities(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("strict: true\n")
    assert not any(line.startswith(("<City>:", "<scene>:")) for line in list_targets())
    with pytest.raises(InputError, match=r"config\.yaml: names no sheet of scenes.*--example"):
        run_workflow(["--cores", "1"])
    with pytest.raises(InputError, match="names no sheet of scenes"):
        show_status([], None)
    assert check_project()[-1][-1].text == "config.yaml: names no sheet of scenes"


@pytest.mark.parametrize(
    ("targets", "needed"),
    [
        ([], True),
        (["report", "-n"], True),
        (["benchmark/us3d/sgm", "audit/us3d/", "-n"], False),
        (["benchmark/us3d/sgm", "dataset"], True),
        (["training_cities"], False),
    ],
)
def test_targets_of_named_datasets_need_no_scenes(tmp_path, monkeypatch, targets, needed):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").touch()
    assert need_scenes(targets) == needed


def test_all_benchmarks_need_scenes_where_a_built_in_dataset_is_among_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").touch()
    assert need_scenes(["benchmark"])
    Path("config.yaml").write_text(
        "benchmark: {datasets: {a: {root: a, layout: us3d, disparity_range: [0, 9]}}}"
    )
    assert not need_scenes(["benchmark"])
