"""The code digests of the rules: an edit of what a digest holds makes the rule's products again."""

from __future__ import annotations

import ast
import re

import pytest
import yaml

from stereotruth.matching import kinds
from stereotruth.products.provenance import source_modules

from ..synthetic.project import ROOT
from ..synthetic.rules import FOLDER, read_rules

RULES = read_rules()
WITH_SCRIPT = {name: rule for name, rule in RULES.items() if rule.script}
# The packages that the digests of each rule reach, all of them: a rule must not grow unseen.
# ``tables`` reads control points.
REACH = {
    "simulate_city": {"simulate", "products"},
    "simulate_image": {"simulate", "products"},
    "simulate_lidar": {"simulate", "products"},
    "simulate_truth": {"simulate", "products"},
    "ingest": {"lidar", "products"},
    "align": {"alignment", "epipolar", "lidar", "products", "tables"},
    "refine": {"alignment", "epipolar", "lidar", "products", "tables"},
    "adjust": {"alignment", "epipolar", "lidar", "products", "tables"},
    "adjusted_alignment": {"alignment", "epipolar", "products"},
    "draw_residuals": {"pages", "alignment", "epipolar", "products"},
    "draw_refinement": {"pages", "alignment", "epipolar", "products"},
    "closure_of_site": {"evaluation", "alignment", "epipolar", "lidar", "products", "tables"},
    "rectify": {"epipolar", "alignment", "products"},
    "rectify_strip": {"epipolar", "alignment", "products"},
    "compare_strips": {"lidar", "products"},
    "move_strips": {"lidar", "products"},
    "surface": {"surface", "epipolar", "lidar", "products"},
    "project": {"disparity", "surface", "alignment", "epipolar", "lidar", "products"},
    "project_right": {"disparity", "surface", "alignment", "epipolar", "lidar", "products"},
    "project_strip": {"disparity", "surface", "alignment", "epipolar", "lidar", "products"},
    "image_heights": {"disparity", "surface", "alignment", "epipolar", "lidar", "products"},
    "export": {"pages", "dataset", "epipolar", "products"},
    "originals": {"dataset", "epipolar", "products"},
    "dataset": {"pages", "dataset", "epipolar", "products"},
    "grid_truth": {"evaluation", "epipolar", "simulate", "products"},
    "evaluate_truth": {"evaluation", "dataset", "products"},
    "evaluate_truth_city": {"evaluation", "dataset", "products"},
    "evaluate_images": {"pages", "evaluation", "dataset", "epipolar", "products"},
    "report_city": {"pages", "report", "dataset", "epipolar", "products"},
    "report_site": {"pages", "report", "alignment", "epipolar", "lidar", "products", "tables"},
    "audit": {"pages", "evaluation", "alignment", "dataset", "epipolar", "products"},
    "training_city": {
        "evaluation",
        "alignment",
        "dataset",
        "epipolar",
        "lidar",
        "simulate",
        "products",
        "tables",
    },
    "training_cities": {
        "evaluation",
        "alignment",
        "dataset",
        "epipolar",
        "lidar",
        "simulate",
        "products",
        "tables",
    },
    "train": {"pages", "matching", "dataset", "products"},
    "match": {"matching", "dataset", "products"},
    "score": {"pages", "matching", "dataset", "products"},
    "submission": {"matching", "dataset", "products"},
    "benchmark_tables": {"pages", "matching", "dataset", "products"},
    "predict_scene": {"matching", "products"},
    "dsm": {"matching", "epipolar", "products"},
    "score_dsm": {"pages", "evaluation", "lidar", "products"},
}
# Modules of the hall that any digest may hold. The sheets are none of them: they say which scenes
# there are, and a scene more is no other scene.
ANYWHERE = {"errors", "job", "kernels", "numerics", "dates", "status"}
# Who reports and records does not change what is computed.
NOT_COVERED = {"job", "products.provenance", "products.making", "report.index_page"}


def covered(rule) -> set[str]:
    """All modules that a rule's digests hold, those of every kind of method too."""
    named = {module for modules in rule.digests().values() for module in modules}
    if rule.digest_of_method():
        named |= {module for kind in kinds.KINDS.values() for module in kind.modules}
    return set(source_modules(*named))


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
    reached = {module.partition(".")[0] for module in covered(WITH_SCRIPT[name])}
    assert reached - ANYWHERE == REACH[name]


def test_no_other_rules_stand_here():
    assert set(REACH) <= set(WITH_SCRIPT)


@pytest.mark.parametrize("name", [n for n, rule in WITH_SCRIPT.items() if makes_something(rule)])
def test_code_digests_hold_the_modules_that_the_scripts_import(name):
    """Otherwise an edit of a module would leave stale results standing."""
    rule = WITH_SCRIPT[name]
    tree = ast.parse((FOLDER / f"scripts/{rule.script}.py").read_text(encoding="utf-8"))
    imported = {
        node.module.removeprefix("stereotruth.")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.startswith("stereotruth.")
    }
    imported = {module for module in imported if not module.startswith("config.")}
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
