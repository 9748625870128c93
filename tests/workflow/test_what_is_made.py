"""Where the rules write: what may be deleted, and what git leaves alone."""

from __future__ import annotations

import re

import pytest

from ..synthetic.project import ROOT
from ..synthetic.rules import read_rules


def folders() -> set[str]:
    """Top folders of all outputs, logs and measurements of the rules."""
    kinds = ("output", "log", "benchmark")
    texts = [rule.directives.get(kind, "") for rule in read_rules().values() for kind in kinds]
    marks = re.compile(r"(caption|category|labels)=.*")
    paths = re.findall(r'"([^"]+)"', "".join(marks.sub("", text) for text in texts))
    return {path.partition("/")[0] for path in paths if "/" in path or path == "dataset"}


def test_the_folders_are_those_of_the_design():
    of_design = {"results", "logs", "tiles", "dataset", "benchmark", "audit", "data", "submission"}
    # the latter if the configuration or the user asks for them
    assert folders() == of_design | {"originals", "score_dsm"}


@pytest.mark.parametrize("name", sorted(folders()))
def test_make_clean_and_git_know_them(name):
    clean = re.search(r"^clean:\n((?:\t.*\n?)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert name in clean[1].split()
    assert f"/{name}/" in (ROOT / ".gitignore").read_text().split()
