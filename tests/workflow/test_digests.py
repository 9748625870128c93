"""The code digests of the rules: an edit of what a digest holds makes the rule's products again."""

from __future__ import annotations

import ast
import re

import pytest
import yaml

from stereobench.methods import kinds
from stereotruth.core.products.provenance import CONFIG, PACKAGES, source_modules

from ..synthetic.project import ROOT
from ..synthetic.rules import FOLDER, read_rules

RULES = read_rules()
WITH_SCRIPT = {name: rule for name, rule in RULES.items() if rule.script}
# The packages that the digests of each rule reach, all of them: a rule must not grow unseen.
REACH = {
    "adjust": {"align", "epipolar", "lidar", "sensor"},
    "adjusted_alignment": {"align", "sensor"},
    "align": {"align", "lidar", "sensor"},
    "draw_residuals": {"align", "pages", "sensor"},
    "audit": {"align", "audit", "epipolar", "pages", "tiles"},
    "match": {"methods", "networks", "scores", "tiles"},
    "score": {"pages", "scores", "tiles"},
    "submission": {"scores", "tiles"},
    "benchmark_tables": {"methods", "pages", "scores", "tiles"},
    "closure_of_site": {"align", "epipolar", "evaluate", "lidar", "sensor"},
    "grid_truth": {"epipolar", "evaluate", "sensor", "stereocities"},
    "evaluate_truth": {"evaluate", "tiles"},
    "evaluate_truth_city": {"evaluate", "tiles"},
    "evaluate_images": {"epipolar", "evaluate", "pages", "tiles"},
    "export": {"align", "epipolar", "pages", "sensor", "tiles"},
    "originals": {"sensor", "tiles"},
    "dataset": {"epipolar", "pages", "sensor", "tiles"},
    "image_heights": {"align", "epipolar", "labels", "lidar", "sensor", "surface"},
    "ingest": {"lidar"},
    "predict_scene": {"methods", "networks"},
    "dsm": {"epipolar", "methods", "sensor"},
    "score_dsm": {"evaluate", "lidar", "pages"},
    "project": {"align", "epipolar", "labels", "lidar", "sensor", "surface"},
    "project_right": {"align", "epipolar", "labels", "lidar", "sensor", "surface"},
    "project_strip": {"align", "epipolar", "labels", "lidar", "sensor", "surface"},
    "rectify": {"align", "epipolar", "sensor"},
    "rectify_strip": {"align", "epipolar", "sensor"},
    "refine": {"align", "epipolar", "lidar", "sensor"},
    "draw_refinement": {"align", "pages", "sensor"},
    "report_city": {"epipolar", "evaluate", "pages", "sensor", "tiles"},
    "report_site": {"align", "evaluate", "lidar", "pages", "sensor"},
    "simulate_city": {"stereocities"},
    "simulate_image": {"stereocities"},
    "simulate_lidar": {"stereocities"},
    "simulate_truth": {"stereocities"},
    "compare_strips": {"lidar"},
    "move_strips": {"lidar"},
    "surface": {"lidar", "sensor", "surface"},
    "train": {"methods", "networks", "pages", "tiles"},
    "training_city": {"align", "epipolar", "evaluate", "lidar", "sensor", "stereocities", "tiles"},
    "training_cities": {
        "align",
        "epipolar",
        "evaluate",
        "lidar",
        "sensor",
        "stereocities",
        "tiles",
    },
}
# Modules of the hall that any digest may hold. The sheets are none of them: they say which scenes
# there are, and a scene more is no other scene.
# Who reports and records does not change what is computed.
NOT_COVERED = {
    "stereotruth.core.job",
    "stereotruth.core.products.provenance",
    "stereotruth.core.products.making",
    "stereotruth.evaluate.report.index_page",
}


def covered(rule) -> set[str]:
    """All modules that a rule's digests hold, those of every kind of method too."""
    named = {module for modules in rule.digests().values() for module in modules}
    if rule.digest_of_method():
        named |= {module for kind in kinds.KINDS.values() for module in kind.modules}
    return set(source_modules(*named))


def room_of(module: str) -> str:
    """The room of a module without its package; empty for the room core, which all reach."""
    room = (*module.split("."), "")[module.startswith(("stereotruth", "stereobench"))]
    return "" if room == "core" else room


def makes_something(rule) -> bool:
    return "output" in rule.directives


def test_the_rules_are_read():
    assert len(WITH_SCRIPT) >= 25
    assert RULES["project_right"].script == "project"
    assert RULES["project_right"].directives["log"] != RULES["project"].directives["log"]
    assert set(RULES["audit"].digests()) == {"measuring", "code"}


def test_every_rule_that_makes_something_has_a_digest_of_its_code():
    without = {
        name
        for name, rule in WITH_SCRIPT.items()
        if makes_something(rule) and not rule.digests().get("code")
    }
    assert without == set()


@pytest.mark.parametrize("name", [n for n, rule in WITH_SCRIPT.items() if makes_something(rule)])
def test_a_digest_reaches_the_packages_that_stand_here(name):
    assert name in REACH, "a new rule: say here what its digest may reach"
    reached = {room_of(module) for module in covered(WITH_SCRIPT[name])}
    assert reached - {""} == REACH[name]


def test_no_other_rules_stand_here():
    assert set(REACH) <= set(WITH_SCRIPT)


@pytest.mark.parametrize("name", [n for n, rule in WITH_SCRIPT.items() if makes_something(rule)])
def test_code_digests_hold_the_modules_that_the_scripts_import(name):
    """Otherwise an edit of a module would leave stale results standing."""
    rule = WITH_SCRIPT[name]
    tree = ast.parse((FOLDER / f"scripts/{rule.script}.py").read_text(encoding="utf-8"))
    imported = {
        node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] in PACKAGES
    }
    imported = {module for module in imported if not module.startswith(CONFIG)}
    assert imported - covered(rule) <= NOT_COVERED


@pytest.mark.parametrize("script", (FOLDER / "scripts").glob("*.py"), ids=lambda f: f.stem)
def test_every_script_has_its_rule_and_log(script):
    """The rule has the script's name and a log below its own; all that is done is done in a job."""
    rule = RULES[script.stem]
    assert rule.script == script.stem
    for name, other in WITH_SCRIPT.items():
        if other.script == script.stem:
            assert f'"logs/{name}/' in other.directives["log"]
    (main,) = (node for node in ast.parse(script.read_text()).body if isinstance(node, ast.If))
    (work,) = (node for node in main.body if isinstance(node, ast.With))
    assert ast.unparse(work.items[0].context_expr).startswith("job(snakemake.log[0], ")
    assert not any(isinstance(node, ast.Expr) for node in main.body)
    if makes_something(rule):
        held_by = "making(snakemake.input, snakemake.output)"
        held = [n for n in ast.walk(main) if isinstance(n, ast.With)]
        assert held_by in {ast.unparse(i.context_expr) for node in held for i in node.items}


@pytest.mark.parametrize("name", [n for n, rule in WITH_SCRIPT.items() if makes_something(rule)])
def test_every_rule_has_digests_of_its_script_and_sources(name):
    """By which Snakemake finds out what is due; it compares no times of scripts."""
    rule = WITH_SCRIPT[name]
    assert f'script=content_of("../scripts/{rule.script}.py"),' in rule.directives["params"]
    assert f'sources=upstream("{name}"),' in rule.directives["params"]
    inputs = rule.directives.get("input", "").splitlines()  # all of them by name
    assert all(re.match(r" {8}(\w+=| {4}|[\])}])", line) for line in inputs if line.strip())
    profile = yaml.safe_load((ROOT / "profiles/default/config.yaml").read_text())
    assert profile["rerun-triggers"] == ["params", "software-env"]
