"""The oldest Snakemake that pyproject.toml allows, and the newest that there is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from ..synthetic.hollow_workflow import Hollow
from ..synthetic.project import ROOT

OLDEST = re.search(r'"snakemake>=([\d.]+)"', (ROOT / "pyproject.toml").read_text())[1]
TARGETS = ("results/rectify/Own/Own-1/epipolar.json", "--configfile", "my.yaml")
OPTIONS = ("--cores", "2", "--scheduler", "greedy")  # the other scheduler needs one more program


@pytest.fixture(scope="module", params=[f"=={OLDEST}", ""], ids=["oldest", "newest"])
def snakemake(request, tmp_path_factory) -> dict[str, str]:
    """An environment in which that Snakemake comes before the one that is installed."""
    place = tmp_path_factory.mktemp("snakemake")
    uv = Path(sys.executable).with_name("uv")
    if not uv.exists():
        pytest.skip("uv is not installed")
    install = [uv, "pip", "install", "--python", sys.executable, "--target", place]
    done = subprocess.run(
        [*install, f"snakemake{request.param}"], capture_output=True, text=True, timeout=600
    )
    if done.returncode:
        pytest.skip(f"cannot be installed: {done.stderr[-200:]}")
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(place), str(ROOT / "src"), str(ROOT)])}


@pytest.mark.slow
def test_it_runs_and_makes_again_what_is_due(snakemake, tmp_path):
    hollow = Hollow(tmp_path / "project")

    def rules(*arguments: str) -> set[str]:
        call = [sys.executable, "-m", "snakemake", *TARGETS, *OPTIONS, *arguments]
        folder = hollow.folder
        done = subprocess.run(call, cwd=folder, env=snakemake, capture_output=True, text=True)
        said = done.stdout + done.stderr
        assert done.returncode == 0, said[-3000:]
        tables = said.split("Job stats:")
        found = re.findall(r"^(\w+)\s+\d+$", tables[-1], flags=re.MULTILINE)
        return {*found} - {"total"} if len(tables) > 1 else set()

    every = {"align", "ingest", "rectify", "rectify_strip", "refine"}
    assert rules() == every
    assert hollow.stale() == []
    for file in (hollow.folder / "in").rglob("*"):
        os.utime(file)
    assert rules("--dry-run") == set()
    hollow.edit("in/gcps.csv")
    assert rules("--dry-run") == every - {"ingest"}
    wrong = [sys.executable, "-m", "snakemake", "tiles/None", *TARGETS[1:], *OPTIONS]
    said = subprocess.run(wrong, cwd=hollow.folder, env=snakemake, capture_output=True, text=True)
    assert said.returncode and "no city 'None'" in said.stderr and "Traceback" not in said.stderr
