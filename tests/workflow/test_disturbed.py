"""Inputs that change under jobs, jobs that are stopped or outlive their run: nothing is stale."""

from __future__ import annotations

import sys

import pytest

from .disturbing import Harness, city_names, make_cities

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]


def test_disturbed_jobs_leave_nothing_stale(data, tmp_path):
    """Rounds of two stages: a file that is read, and one deep in the folder of a dataset."""
    project = make_cities(tmp_path, 3, data)
    harness = Harness(project, city_names(3), seed=11)
    found = list(harness.rounds(["align", "match"], 6))
    assert len(found) >= 12
    assert [one for one in found if one["stale"]] == []
