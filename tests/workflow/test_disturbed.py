"""Inputs that change under jobs, jobs that are stopped or outlive their run: nothing is stale."""

from __future__ import annotations

import os
import sys

import pytest

from ..synthetic.disturbed_stages import city_names, make_cities
from ..synthetic.forked_snakemake import runner
from .disturbing import Harness

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]


def test_disturbed_jobs_leave_nothing_stale(data, tmp_path):
    """Rounds of two stages: a file that is read, and one deep in the folder of a dataset."""
    project = make_cities(tmp_path, 3, data)
    harness = Harness(project, city_names(3), seed=11, forker=runner())
    found = list(harness.rounds(["align", "match"], 6))
    assert len(found) >= 12
    assert [one for one in found if one["stale"]] == []
    # an edit that size and time do not show is seen by its content, and may be taken back
    city, align = project.folder / "C0", "results/align/C0/C0-1/alignment.json"
    points = city / "gcps.csv"
    then, text = points.stat(), points.read_text()
    points.write_text(text.replace("1", "2", 1) if "1" in text else text)
    os.utime(points, ns=(then.st_atime_ns, then.st_mtime_ns))
    plan = project.snakemake("--dry-run", align, "--configfile", "my.yaml")
    assert plan.jobs == {"align": 1}
    assert f"{align}: C0/gcps.csv changed" in plan.text
    points.write_text(text)
    os.utime(points, ns=(then.st_atime_ns, then.st_mtime_ns))
    assert project.plan(align, "--configfile", "my.yaml") == {}
