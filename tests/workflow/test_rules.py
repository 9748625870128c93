"""What each rule states: digests, logs, environments, memory and time, and where it writes."""

from __future__ import annotations

import ast
import re

import yaml

from stereobench.methods import kinds
from stereotruth.core.products.provenance import CONFIG, source_modules

from ..synthetic.project import ROOT
from ..synthetic.rules import FOLDER, read_rules

RULES = read_rules()
WITH_SCRIPT = {name: rule for name, rule in RULES.items() if rule.script}
MAKING = {name: rule for name, rule in WITH_SCRIPT.items() if "output" in rule.directives}
# Who reports and records does not change what is computed.
NOT_COVERED = {
    "stereotruth.core.job",
    "stereotruth.core.products.provenance",
    "stereotruth.core.products.making",
    "stereotruth.evaluate.report.index_page",
}
SLURM = yaml.safe_load((ROOT / "profiles/slurm/config.yaml").read_text())
OVERHEAD_MB = 300  # of the Snakemakes in a job


def covered(rule) -> set[str]:
    """All modules that a rule's digests hold, those of every kind of method too."""
    named = {module for modules in rule.digests().values() for module in modules}
    if rule.digest_of_method():
        named |= {module for kind in kinds.KINDS.values() for module in kind.modules}
    return set(source_modules(*named))


def test_the_rules_are_read():
    assert len(WITH_SCRIPT) >= 25
    assert RULES["project_strip"].script == "project"
    assert RULES["project_strip"].directives["log"] != RULES["project"].directives["log"]
    assert set(RULES["audit"].digests()) == {"measuring", "code"}


def test_code_digests_hold_the_modules_that_the_scripts_import_and_no_command():
    """Otherwise an edit would leave stale results standing; or the sheets' reader, which says which
    scenes there are, would make all of them again."""
    for name, rule in MAKING.items():
        modules = covered(rule)
        tree = ast.parse((FOLDER / f"scripts/{rule.script}.py").read_text(encoding="utf-8"))
        imported = {
            node.module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            and node.module.startswith(("stereotruth.", "stereobench.", "stereocities."))
            and not node.module.startswith(CONFIG)
        }
        assert rule.digests().get("code"), name
        assert imported - modules <= NOT_COVERED, name
        assert "stereotruth.core.sheets" not in modules, name
        assert not any(module.startswith("stereotruth.project") for module in modules), name


def test_every_rule_has_digests_of_its_sources_and_inputs_by_name():
    """By which Snakemake finds out what is due; it compares no times of scripts."""
    for name, rule in MAKING.items():
        more = "" if rule.script == name else f', "{rule.script}"'
        assert f'sources=upstream("{name}"{more}),' in rule.directives["params"]
        inputs = rule.directives.get("input", "").splitlines()
        assert all(re.match(r" {8}(\w+=| {4}|[\])}])", line) for line in inputs if line.strip())
    profile = yaml.safe_load((ROOT / "profiles/default/config.yaml").read_text())
    assert profile["rerun-triggers"] == ["params", "software-env"]


def test_every_script_has_its_rule_and_does_all_in_a_job():
    """The rule has the script's name and a log below its own; all that is done is done in a job."""
    for script in (FOLDER / "scripts").glob("*.py"):
        assert RULES[script.stem].script == script.stem
        (main,) = (node for node in ast.parse(script.read_text()).body if isinstance(node, ast.If))
        (work,) = (node for node in main.body if isinstance(node, ast.With))
        held = ast.unparse(work.items[0].context_expr)
        assert held.startswith(("rule_job(snakemake, ", "job(snakemake.log[0], "))
        assert not any(isinstance(node, ast.Expr) for node in main.body)
        if script.stem in MAKING and held.startswith("job"):
            assert "making(snakemake.input, snakemake.output)" in ast.unparse(main)
    for name, rule in WITH_SCRIPT.items():
        assert f'"logs/{name}/' in rule.directives["log"]


def test_the_slurm_profile_gives_each_rule_what_it_states_and_more_with_each_attempt():
    for name, rule in RULES.items():
        stated = rule.directives.get("resources", "")
        own = {key: int(n) for key, n in re.findall(r"\b(mem_mb|runtime)=(\d+)", stated)}
        if own:
            assert SLURM["set-resources"][name] == {
                "mem_mb": f"{own['mem_mb'] + OVERHEAD_MB} * attempt",
                "runtime": f"{own['runtime']} * attempt",
            }, name
    assert {*SLURM["groups"], *SLURM["set-resources"]} <= set(RULES)


def test_what_is_made_lies_in_folders_that_make_clean_and_git_know():
    marks = re.compile(r"(caption|category|labels)=.*")
    kinds_of_paths = ("output", "log", "benchmark")
    texts = [rule.directives.get(kind, "") for rule in RULES.values() for kind in kinds_of_paths]
    paths = re.findall(r'"([^"]+)"', "".join(marks.sub("", text) for text in texts))
    folders = {path.partition("/")[0] for path in paths if "/" in path or path == "dataset"}
    clean = re.search(r"^clean:\n((?:\t.*\n?)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    ignored = (ROOT / ".gitignore").read_text().split()
    for name in folders:
        assert name in clean[1].split() and f"/{name}/" in ignored
    assert {"results", "logs", "tiles", "dataset", "benchmark", "audit"} <= folders


def test_the_snakemake_catalog_is_told_how_to_use_the_workflow():
    usage = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert usage["software-stack-deployment"]["conda"] is False and usage["report"]
    snakefile = (ROOT / "Snakefile").read_text()
    assert "config/config.yaml" in snakefile and "\nreport: " in snakefile
    assert not any("conda" in rule.directives for rule in RULES.values())
