"""What runs again after an edit: the rows of the table of edits in docs/explanation/reruns.md."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from ..synthetic.hollow_workflow import make_hollow
from .failing import Failures

pytestmark = pytest.mark.slow
STRIPS = {"rectify": {"rectify_strip"}, "project": {"project_strip", "project_right"}}
OF_TILES = {"evaluate_images", "report_city", "originals", "dataset", "audit", "match", "score"}
OF_TILES |= {"submission", "benchmark_tables", "train"}
OF_TRUTH = {"evaluate_truth", "evaluate_truth_city"}  # only of the synthetic city
OF_IMAGES = {"predict_scene", "dsm", "score_dsm"}
PROJECT = {"project", *STRIPS["project"], "export", *OF_TILES}
RECTIFY = {"rectify", "rectify_strip", *OF_IMAGES, *PROJECT}
GRID_TRUTH = {"grid_truth", *OF_TRUTH}
REFINE = {"refine", "draw_refinement"}
ALIGN = {"align", "draw_residuals", *REFINE}
METHOD = {"match", "score", "submission", "benchmark_tables", *OF_IMAGES}
FILES: list[tuple[str, set[str]]] = [
    ("in/gcps.csv", {*ALIGN, *RECTIFY}),
    ("in/left.tif", {"surface", *ALIGN, *RECTIFY}),
    ("in/left.tif.msk", {"surface", *ALIGN, *RECTIFY}),  # a new one
    ("in/lidar/1.laz", {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY}),
    ("in/lidar/3.laz", {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY}),  # a new one
    ("geoid.tif", {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY}),
    ("mine.py", METHOD),
    ("helper.py", METHOD),  # which mine.py imports
]
KEYS: list[tuple[str, Any, set[str]]] = [
    (
        "ingest.drop_classes",
        [7],
        {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY, *GRID_TRUTH},
    ),
    ("alignment.model", "shift", {*ALIGN, *RECTIFY, *GRID_TRUTH}),
    ("alignment.refine", False, {*RECTIFY, *GRID_TRUTH}),
    ("rectify.panchromatic", 1, {*REFINE, *RECTIFY, *GRID_TRUTH}),
    ("project.edge_margin_px", 1, {*PROJECT, *OF_TRUTH}),
    (
        "tiles.size",
        512,
        {"export", *OF_TILES, *OF_TRUTH, "training_city", "training_cities"},
    ),
    ("quality.max_gcp_rms_px", 2, {"export", *OF_TILES, *OF_TRUTH}),
    ("evaluation.building_share", 0.03, {"export", *OF_TILES, *OF_TRUTH}),
    ("strict", True, {*ALIGN, *RECTIFY, *GRID_TRUTH}),
    ("dataset.catalogs", ["croissant"], OF_TILES - {"evaluate_images", "report_city", "originals"}),
    ("report.sliders", 5, {"report_city"}),
    ("benchmark.bootstrap", 20, {"score", "submission", "benchmark_tables"}),
    ("predict.block_px", 256, OF_IMAGES),
    ("strips", 1, set()),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Failures:
    """All rules have run, without their numerics."""
    failures = Failures(make_hollow(tmp_path_factory.mktemp("hollow") / "project"), seed=1)
    failures.prepare(edits=())
    return failures


@pytest.fixture
def rules_after(made) -> Iterator[Callable[[str, bytes], set[str]]]:
    """The rules that are planned after a file has other content, which it then loses again."""
    before: dict[Path, bytes | None] = {}

    def plan(name: str, content: bytes) -> set[str]:
        file = made.folder / name
        before.setdefault(file, file.read_bytes() if file.exists() else None)
        file.write_bytes(content)
        status, rules = made.run("--dry-run")
        assert status == 0, made.said()[-2000:]
        return rules

    yield plan
    for file, content in before.items():
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)


@pytest.mark.parametrize(("file", "rules"), FILES)
def test_an_edited_file(rules_after, file, rules):
    assert rules_after(file, b"import helper\n# edited\nEDITED = 1\n") == rules


@pytest.mark.parametrize(("key", "value", "rules"), KEYS)
def test_an_edited_key(made, rules_after, key, value, rules):
    config = yaml.safe_load((made.folder / "my.yaml").read_text())
    *above, last = key.split(".")
    place = config
    for name in above:
        place = place.setdefault(name, {})
    place[last] = value
    assert rules_after("my.yaml", yaml.safe_dump(config).encode()) == rules


def test_an_edited_script(made, rules_after):
    script = "workflow/scripts/report_city.py"
    text = (made.folder / script).read_bytes()
    assert rules_after(script, text + b"# a comment\n") == set()
    assert rules_after(script, text + b"EDITED = 1\n") == {"report_city"}
