"""Digests of code and records of products."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from stereotruth.core.products import provenance

GRIDS, SHEETS = "stereotruth.core.products.grids", "stereotruth.core.sheets"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the package that a test may edit."""
    core = tmp_path / "stereotruth" / "core"
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(provenance.__file__).parents[2], core.parent, ignore=ignored)
    monkeypatch.setattr(provenance, "SOURCES", tmp_path)
    monkeypatch.setattr(provenance, "CACHE", tmp_path / "known.json")
    provenance._sources.cache_clear()
    yield core
    provenance._sources.cache_clear()


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def digests(*modules: str) -> list[str]:
    return [provenance.source_digest(module) for module in modules]


def test_what_runs_changes_the_digest_and_nothing_else_does(package):
    """Also of an imported module, and a table of its name; what is remembered is never stale."""
    first = digests(GRIDS, SHEETS)
    edit(package / "errors.py", '"""The one exception', '# a remark\n"""Another wording: the one')
    assert digests(GRIDS, SHEETS) == first
    edit(package / "products/grids.py", "clevel=5", "clevel=7")
    second = digests(GRIDS, SHEETS)
    assert second[0] != first[0] and second[1] == first[1]
    (package / "products/grids.tsv").write_text("of one kind\n")
    assert digests(GRIDS)[0] not in (first[0], second[0])
    (package / "products/grids.tsv").unlink()
    edit(package / "products/grids.py", "clevel=7", "clevel=5")
    for _ in range(2):
        provenance._sources.cache_clear()
        assert digests(GRIDS, SHEETS) == first
        provenance.CACHE.write_text("{")
    edit(package / "errors.py", "FULL = (", "FULL = (0, ")
    assert digests(GRIDS)[0] != first[0]


STAGES = (
    "stereotruth.lidar.ingest",
    "stereotruth.align.align",
    "stereotruth.epipolar.rectify",
    "stereotruth.labels.project",
    "stereotruth.tiles.export",
)


def test_a_stage_depends_on_no_later_stage_and_on_no_simulation():
    """Otherwise an edit of a late stage would rerun an early one."""
    for n, stage in enumerate(STAGES):
        modules = set(provenance.source_modules(stage))
        assert not modules & {*STAGES[n + 1 :], SHEETS}, stage
        assert not any(m.startswith(("stereocities", provenance.CONFIG)) for m in modules), stage


def test_the_simulator_shares_no_code_with_the_pipeline():
    simulator = ("stereocities.render", "stereocities.lidar", "stereocities.truth")
    rooms = {".".join(m.split(".")[:2]) for m in provenance.source_modules(*simulator)}
    assert {room for room in rooms if room.startswith("stereotruth.")} == {"stereotruth.core"}


def test_records_are_equal_for_equal_work(tmp_path):
    file = tmp_path / "a.txt"
    file.write_bytes(b"abc")
    record = provenance.describe([file], {"x": 1}, "code")
    sha_of_abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert record == provenance.describe({"a.txt": sha_of_abc}, {"x": 1}, "code")
    assert str(tmp_path) not in str(record) and "numpy" in record["libraries"]
