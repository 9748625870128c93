"""What a run can make, typos of it, and the arguments of Snakemake."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.project.check import check_project
from stereotruth.project.main import app
from stereotruth.project.new_project import copy_profile
from stereotruth.project.project import FILES, configured
from stereotruth.project.run_workflow import (
    TARGETS,
    arguments_for,
    completions,
    config_files,
    list_targets,
    need_scenes,
    refuse_unknown,
    rules,
    run_workflow,
)
from stereotruth.project.status import show_status

SNAKEFILE = ["--snakefile", str(FILES / "Snakefile")]


@pytest.fixture
def empty(tmp_path, monkeypatch) -> Path:
    """A folder whose configuration says nothing."""
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").touch()
    return tmp_path


def test_targets_are_listed_with_the_names_of_the_project(folder):
    lines = list_targets()
    assert [line.split()[0] for line in lines[: len(TARGETS)]] == list(TARGETS)
    assert "<City>: Good" in lines and "<scene>: Good-1" in lines


def test_words_of_a_run_are_completed(folder, monkeypatch, capsys):
    """As bash asks for them."""
    assert {"slurm", "s3"} <= set(completions(["tiles/Good", "--profile"]))
    assert "results/project/Good/Good-1.zarr" in completions([])

    def asked(line: str) -> list[str]:
        monkeypatch.setenv("_STEREOTRUTH_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
        with pytest.raises(SystemExit):
            app(prog_name="stereotruth")
        return capsys.readouterr().out.split()

    assert asked("stereotruth run report tiles/") == ["tiles/Good"]
    assert asked("stereotruth status G") == ["Good"]
    assert asked("stereotruth profile sl") == ["slurm"]


def test_each_target_is_what_a_rule_makes():
    files = sorted((FILES / "workflow" / "rules").glob("*.smk"))
    text = "".join(file.read_text(encoding="utf-8") for file in files)
    for target in TARGETS:
        path = re.sub(r"<(\w+)>", lambda found: f"{{{found[1].lower()}}}", target)
        path = path.removesuffix(".zarr")  # of either side
        assert f'"{path}' in text if "/" in path else path in rules(), target


def test_a_typo_is_told_with_what_it_may_mean(folder):
    for word, meant in (
        ("reprot", "report"),
        ("tiles/Goood", "tiles/Good"),
        ("results/report/Goood/index.html", "results/report/Good/index.html"),
        ("benchmark/syntetic/sgm", "benchmark/synthetic/sgm"),
    ):
        with pytest.raises(InputError, match=f"did you mean '{meant}'"):
            refuse_unknown([word, "--cores", "2"])
    refuse_unknown(["report", "tiles/Good", "results/x.json", "--forcerun", "anything"])
    refuse_unknown(["results/closure/Good.json", "results/training_cities/cities/1"])


def test_targets_of_named_datasets_need_no_scenes(empty):
    for targets, needed in (
        ([], True),
        (["report", "-n"], True),
        (["benchmark/us3d/sgm", "audit/us3d/", "-n"], False),
        (["benchmark/us3d/sgm", "dataset"], True),
        (["training_cities"], False),
        (["benchmark"], True),  # a built-in dataset is among them
    ):
        assert need_scenes(targets) == needed
    own = "benchmark: {datasets: {a: {root: a, layout: us3d, disparity_range: [0, 9]}}}"
    Path("config.yaml").write_text(own)
    assert not need_scenes(["benchmark"])


def test_a_folder_without_a_sheet_of_scenes_has_no_built_in_cities(empty):
    assert not any(line.startswith(("<City>:", "<scene>:")) for line in list_targets())
    for ask in (lambda: run_workflow(["--cores", "1"]), lambda: show_status([], None)):
        with pytest.raises(InputError, match="names no sheet of scenes"):
            ask()
    assert check_project()[-1][-1].text == "config.yaml: names no sheet of scenes"


@pytest.mark.parametrize(
    ("given", "passed"),
    [
        (["tiles/A"], ["tiles/A", "--configfile", "config.yaml", "--cores", "all"]),
        (["tiles/A", "-c2"], ["tiles/A", "-c2", "--configfile", "config.yaml"]),
        (["--configfile=b.yaml"], ["--configfile=b.yaml", "--cores", "all"]),
        (["a", "--", "-k"], ["a", "-k", "--configfile", "config.yaml", "--cores", "all"]),
        (["--profile", "p"], ["--profile", "p", "--configfile", "config.yaml"]),
    ],
)
def test_options_are_passed_on(empty, given, passed):
    assert arguments_for(given) == [*SNAKEFILE, *passed]


def test_a_profile_of_the_package_is_named_without_its_path(empty, monkeypatch):
    shipped = str(FILES / "profiles" / "default")
    assert arguments_for(["--profile", "default"])[2:4] == ["--profile", shipped]
    assert arguments_for(["--profile=default"])[2] == f"--profile={shipped}"
    assert arguments_for(["--profile", "my-site"])[3] == "my-site"
    monkeypatch.setattr("stereotruth.project.run_workflow.find_spec", lambda name: None)
    copy_profile("slurm", Path("my-site"))
    for name, plugin in (("slurm", "executor-plugin-slurm"), ("my-site", "executor"), ("s3", "s3")):
        with pytest.raises(InputError, match=plugin):
            arguments_for(["--profile", name])


def test_the_built_in_cities_are_asked_for_by_name(empty, monkeypatch):
    """In a folder of a project the message says where the project is."""
    inside = empty / "tiles" / "A"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    for ask in (lambda: arguments_for(["tiles/A"]), configured):
        with pytest.raises(InputError, match=r"cd \.\./\.\."):
            ask()
    own = ["--example", "tiles/Qichun", "-j1"]
    assert arguments_for(own) == [*SNAKEFILE, "tiles/Qichun", "-j1"]


def test_the_files_of_the_configuration_are_found_and_read_before_the_run(empty):
    for name in ("a.yaml", "b.yaml", "c.yaml"):
        Path(name).touch()
    given = ["--configfile", "a.yaml", "b.yaml", "--cores", "2", "--configfiles=c.yaml", "tiles/X"]
    assert [file.name for file in config_files(given)] == ["a.yaml", "b.yaml", "c.yaml"]
    assert config_files(["--cores", "a.yaml"]) == []
    Path("config.yaml").write_text("seed: 1\n", encoding="utf-16")
    with pytest.raises(InputError, match=r"config\.yaml: is no UTF-8"):
        run_workflow(["--dry-run"])
