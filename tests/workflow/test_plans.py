"""What Snakemake would run, and what it refuses, before any work."""

from __future__ import annotations

import os
import time

import pytest
import yaml

from stereotruth.core.errors import InputError
from stereotruth.project.project import configured, lidar_of, read_scenes


def test_a_city_is_planned_from_nothing(project):
    jobs = project.plan("tiles/Qichun")
    assert jobs["export"] == 1
    assert jobs["align"] == jobs["refine"] == jobs["rectify"] == jobs["project"] == 2
    assert jobs["simulate_city"] == 1 and jobs["simulate_image"] == 4
    assert jobs["ingest"] == jobs["simulate_lidar"] >= 4


def test_exact_truth_is_planned_by_scene_and_by_city(project):
    jobs = project.plan("evaluate")
    assert jobs["grid_truth"] == jobs["evaluate_truth"] == 7
    assert jobs["evaluate_truth_city"] == 6


def test_training_cities_are_planned_for_who_trains_on_them(project):
    more = {"root": "results/training_cities/19", "layout": "whu", "disparity_range": [-64, 128]}
    config = {"benchmark": {"datasets": {"more": more}}}
    (project.folder / "more.yaml").write_text(yaml.safe_dump(config))
    jobs = project.plan("results/train/more/stereonet/best.pt", "--configfile", "more.yaml")
    assert jobs == {"training_city": 6, "training_cities": 1, "train": 1}  # 5 to train on


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tiles/Quichun"], ["no city 'Quichun'", "Qichun"]),
        (["tiles/Qichun", "--config", "tile=3"], ["unknown key 'tile'", "'tiles'"]),
    ],
)
def test_a_wrong_call_ends_before_any_work(project, arguments, words):
    run = project.refuse(*arguments)
    for word in words:
        assert word in run.text
    assert not (project.folder / "results").exists()
    assert not (project.folder / "data").exists()


def test_a_forgotten_configuration_is_thought_of(project):
    run = project.snakemake("--dry-run", "tiles/Mine")
    assert run.status != 0
    for word in ("no city 'Mine'", "(configuration: config/config.yaml)", "add --configfile FILE"):
        assert word in run.text
    row = {"scene": "Mine-1", "city": "Mine"}
    for name in ("left_image", "right_image", "lidar", "gcps"):
        (project.folder / f"{name}.laz").touch()
        row[name] = f"{name}.laz"
    mine = project.add_scene("mine", [row])
    run = project.snakemake("--dry-run", "tiles/Mime", "--configfile", mine)
    assert run.status != 0
    for word in ("no city 'Mime'", "(configuration: config/config.yaml, mine.yaml)", "one of Mine"):
        assert word in run.text
    assert "FILE" not in run.text  # it was not forgotten


def test_a_missing_file_is_named(project, monkeypatch):
    """By what a plan asks of each scene, and by a plan."""
    row = {"scene": "Mine-1", "city": "Mine"}
    columns = ("left_image", "right_image", "lidar", "geoid", "gcps")
    for name in columns:
        (project.folder / f"{name}.laz").touch()
        row[name] = f"{name}.laz"
    mine = project.add_scene("mine", [row])
    monkeypatch.chdir(project.folder)
    for column in columns:
        file = project.folder / f"{column}.laz"
        file.unlink()
        with pytest.raises(InputError) as refused:
            settings, _ = configured([mine])
            lidar_of(read_scenes(settings)[1]["Mine-1"], settings)
        for word in ("Mine-1", file.name, "mine_scenes.tsv", "Remedy"):
            assert word in str(refused.value)
        file.touch()
    file.unlink()
    run = project.refuse("tiles/Mine", "--configfile", mine)
    assert str(refused.value) in run.text


def test_a_scene_without_gcps_is_refused_unless_it_is_refined(project):
    row = {"scene": "Mine-1", "city": "Mine"}
    for name in ("left_image", "right_image", "lidar"):
        (project.folder / f"{name}.laz").touch()
        row[name] = f"{name}.laz"
    mine = project.add_scene("mine", [row], alignment={"refine": False})
    run = project.snakemake("--dry-run", "tiles/Mine", "--configfile", mine)
    assert run.status != 0
    for word in ("Mine-1", "no GCPs", "alignment.refine", "Remedy"):
        assert word in run.text
    jobs = project.plan("tiles/Mine", "--configfile", project.add_scene("mine", [row]))
    assert jobs["refine"] == 1


PACK = """
benchmark:
  datasets: {mine: {root: mine, layout: whu, disparity_range: [-8, 8]}}
  methods:
    ours: {kind: function, function: "pack.stereo:match"}
    gone: {kind: function, function: "no_such_module:match"}
"""


@pytest.mark.slow
def test_an_edit_behind_a_module_is_seen_and_a_missing_one_refused(project):
    (project.folder / "mine").mkdir()
    (project.folder / "pack").mkdir()
    for name in ("__init__.py", "stereo.py", "helper.py"):
        (project.folder / "pack" / name).write_text("raise SystemExit('imported')\n")
    (project.folder / "pack.yaml").write_text(PACK)
    made = "results/match/mine/ours"
    (project.folder / made).mkdir(parents=True)
    touched = project.snakemake("--touch", "--force", made, "--configfile", "pack.yaml")
    assert touched.status == 0, touched.text
    assert project.plan(made, "--configfile", "pack.yaml") == {}
    later = time.time() + 5
    (project.folder / "pack/helper.py").write_text("# edited\n")
    os.utime(project.folder / "pack/helper.py", (later, later))
    assert project.plan(made, "--configfile", "pack.yaml") == {"match": 1}
    run = project.snakemake("--dry-run", "results/match/mine/gone", "--configfile", "pack.yaml")
    assert run.status != 0
    for word in ("benchmark.methods.gone", "cannot import no_such_module", "Remedy"):
        assert word in run.text


def test_a_setting_that_a_method_does_not_have_ends_the_plan(project):
    wrong = "{benchmark: {methods: {mine: {kind: pandora, uncertainty: true}}}}"
    (project.folder / "wrong.yaml").write_text(wrong)
    made = "results/match/synthetic/mine"
    run = project.snakemake("--dry-run", made, "--configfile", "wrong.yaml")
    assert run.status != 0
    for word in ("benchmark.methods.mine", "has no setting 'uncertainty'", "pipeline"):
        assert word in run.text
