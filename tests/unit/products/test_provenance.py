from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from stereotruth.products import provenance


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the package's source that a test may edit."""
    copy = tmp_path / "stereotruth"
    shutil.copytree(provenance.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "PACKAGE", copy)
    provenance._sources.cache_clear()
    yield copy
    provenance._sources.cache_clear()


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_digest_follows_imports_within_the_package():
    modules = provenance.source_modules("products.grids")
    assert {"products.grids", "errors"} <= set(modules)
    assert "sheets" not in modules


def test_a_change_of_an_imported_module_changes_the_digest(package):
    before = provenance.source_digest("products.grids"), provenance.source_digest("sheets")
    edit(package / "products" / "grids.py", "clevel=5", "clevel=7")
    after = provenance.source_digest("products.grids"), provenance.source_digest("sheets")
    assert before[0] != after[0]
    assert before[1] == after[1]


def test_digests_are_remembered_but_never_in_place_of_an_edit(package):
    first = provenance.source_digest("products.grids")
    (remembered,) = (package / "__pycache__").glob("sources-*.json")
    provenance._sources.cache_clear()
    assert provenance.source_digest("products.grids") == first
    edit(package / "products" / "grids.py", "clevel=5", "clevel=7")
    assert provenance.source_digest("products.grids") != first
    edit(package / "products" / "grids.py", "clevel=7", "clevel=5")
    provenance._sources.cache_clear()
    assert provenance.source_digest("products.grids") == first
    remembered.write_text("{")
    provenance._sources.cache_clear()
    assert provenance.source_digest("products.grids") == first


def test_a_table_that_a_module_reads_changes_the_digest(package):
    first = provenance.source_digest("products.grids"), provenance.source_digest("sheets")
    table = package / "products" / "grids.tsv"
    table.write_text("of one kind\n")
    second = provenance.source_digest("products.grids")
    table.write_text("of another\n")
    third = provenance.source_digest("products.grids"), provenance.source_digest("sheets")
    assert len({first[0], second, third[0]}) == 3
    assert first[1] == third[1]


def test_comments_and_docstrings_do_not_change_the_digest(package):
    before = provenance.source_digest("errors")
    edit(package / "errors.py", '"""The one exception', '# a remark\n"""Another wording: the one')
    # the docstring has moved behind a comment and changed
    assert provenance.source_digest("errors") == before


STAGES = (
    "lidar.ingest",
    "alignment.align",
    "epipolar.rectify",
    "disparity.project",
    "dataset.export",
)


def test_a_stage_depends_on_no_later_stage_and_on_no_simulation():
    """Otherwise an edit of a late stage would rerun an early one."""
    for n, stage in enumerate(STAGES):
        modules = set(provenance.source_modules(stage))
        assert not modules & set(STAGES[n + 1 :]), stage
        assert not any(module.startswith("simulate") for module in modules), stage
        assert "sheets" not in modules


def test_the_simulator_shares_no_code_with_the_pipeline():
    modules = set(provenance.source_modules("simulate.render", "simulate.lidar", "simulate.truth"))
    assert not modules & {*STAGES, "epipolar.rpc", "epipolar.model", "disparity.rays"}


def test_records_hold_checksums_and_are_equal_for_equal_work(tmp_path):
    file = tmp_path / "a.txt"
    file.write_bytes(b"abc")
    record = provenance.describe([file], {"x": 1}, "code")
    sha_of_abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert record["inputs"] == {"a.txt": sha_of_abc}
    assert provenance.digest(record) == provenance.digest(
        provenance.describe({"a.txt": sha_of_abc}, {"x": 1}, "code")
    )
    assert str(tmp_path) not in str(record)


def test_versions_of_what_decides_bytes_stand_in_the_provenance():
    told = provenance.describe({}, {}, "code")["libraries"]
    assert {"numpy", "scipy", "numba", "zarr", "rasterio"} <= set(told)
    assert all(version[0].isdigit() for version in told.values())


def test_a_package_that_is_read_only_is_no_obstacle(package, monkeypatch):
    """Where ``__pycache__`` is there and cannot be written to, as in containers."""

    def refused(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(Path, "write_text", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    assert len(provenance.source_digest("errors")) == 16
