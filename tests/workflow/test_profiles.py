"""The SLURM profile: read by a plan without submitting, and in step with the rules."""

from __future__ import annotations

import re

import yaml

from ..synthetic.project import ROOT

PROFILE = yaml.safe_load((ROOT / "profiles/slurm/config.yaml").read_text())
OVERHEAD_MB = 300  # of the Snakemakes in a job


def asked() -> dict[str, dict[str, int]]:
    """Memory and run time that the rules state, by rule."""
    found: dict[str, dict[str, int]] = {}
    for file in sorted((ROOT / "workflow/rules").glob("*.smk")):
        for text in re.split(r"^(?=rule |use rule )", file.read_text(), flags=re.MULTILINE)[1:]:
            parent, name = re.match(r"(?:use rule (\w+) as|rule) (\w+)", text).groups()
            own = {key: int(n) for key, n in re.findall(r"\b(mem_mb|runtime)=(\d+)", text)}
            found[name] = {**found.get(parent, {}), **own}
    return {name: own for name, own in found.items() if own}


def test_the_profile_gives_each_rule_what_it_states_and_more_with_each_attempt():
    given = PROFILE["set-resources"]
    rules = asked()
    assert {"ingest", "project", "project_right", "export"} <= set(rules)
    for rule, own in rules.items():
        assert given[rule] == {
            "mem_mb": f"{own['mem_mb'] + OVERHEAD_MB} * attempt",
            "runtime": f"{own['runtime']} * attempt",
        }, rule
    assert set(PROFILE["groups"]) <= set(rules)


def test_it_plans_without_submitting(project):
    jobs = project.plan("tiles/Qichun", "--profile", "profiles/slurm")
    assert jobs == project.plan("tiles/Qichun")
