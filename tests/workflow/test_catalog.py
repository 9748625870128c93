"""What the Snakemake workflow catalog asks of a standardized workflow."""

from __future__ import annotations

import yaml

from ..synthetic.project import ROOT
from ..synthetic.rules import read_rules


def test_the_catalog_is_told_how_to_use_the_workflow():
    usage = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert usage["software-stack-deployment"]["conda"] and usage["report"]
    assert usage["mandatory-flags"]["flags"] == ""
    for file in ("config/README.md", "config/config.yaml", "profiles/default/config.yaml"):
        assert (ROOT / file).is_file()
    snakefile = (ROOT / "Snakefile").read_text()
    assert "config/config.yaml" in snakefile and "\nreport: " in snakefile


def test_every_script_has_a_conda_environment():
    without = [
        name
        for name, rule in read_rules().items()
        if rule.script and "conda" not in rule.directives
    ]
    assert without == []
    names = yaml.safe_load((ROOT / "envs/workflow.yaml").read_text())["dependencies"]
    assert {"pip": [".."]} in names
