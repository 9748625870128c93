"""A twin through the whole workflow: a LAZ in, labels judged by the exact truth out."""

from __future__ import annotations

import json

import pytest

from stereotruth.project.simulated_project import Options, with_twin

from ..synthetic import house_points as place


@pytest.mark.slow
def test_labels_of_a_twin_are_judged_by_its_truth(project, tmp_path) -> None:
    file = place.write_place(tmp_path / "house.laz")
    with_twin(tmp_path / "twin", file, Options(density=6.0))
    for made in ("data", "scenes.tsv", "cities.tsv", "images.tsv", "config.yaml"):
        (tmp_path / "twin" / made).rename(project.folder / made)
    config = project.folder / "config.yaml"
    config.write_text(config.read_text().replace("size: 128", "size: 96"))
    run = project.snakemake("tiles/Twin", "evaluate", "--configfile", "config.yaml")
    assert run.status == 0, run.text[-4000:]
    figures = json.loads((project.folder / "results/evaluate/Twin/truth.json").read_text())
    whole = figures["whole_scene"]
    assert whole["errors"]["count"] > 5000
    assert whole["errors"]["mean_absolute"] < 0.15
    again = project.plan("tiles/Twin", "evaluate", "--configfile", "config.yaml")
    assert again == {}
    city = project.folder / "data/synthetic/Twin/city.json"
    city.write_text(city.read_text().replace('"pose_seed": 1', '"pose_seed": 2'))
    assert {"simulate_image", "ingest", "project"} <= set(
        project.plan("tiles/Twin", "--configfile", "config.yaml")
    )
