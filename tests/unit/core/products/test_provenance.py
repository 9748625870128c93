from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from stereotruth.core.products import provenance


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the room core that a test may edit."""
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


def test_digest_follows_imports_within_the_package():
    modules = provenance.source_modules("stereotruth.core.products.grids")
    assert {"stereotruth.core.products.grids", "stereotruth.core.errors"} <= set(modules)
    assert "stereotruth.core.sheets" not in modules


def test_a_change_of_an_imported_module_changes_the_digest(package):
    before = (
        provenance.source_digest("stereotruth.core.products.grids"),
        provenance.source_digest("stereotruth.core.sheets"),
    )
    edit(package / "products" / "grids.py", "clevel=5", "clevel=7")
    after = (
        provenance.source_digest("stereotruth.core.products.grids"),
        provenance.source_digest("stereotruth.core.sheets"),
    )
    assert before[0] != after[0]
    assert before[1] == after[1]


def test_digests_are_remembered_but_never_in_place_of_an_edit(package):
    first = provenance.source_digest("stereotruth.core.products.grids")
    remembered = provenance.CACHE
    provenance._sources.cache_clear()
    assert provenance.source_digest("stereotruth.core.products.grids") == first
    edit(package / "products" / "grids.py", "clevel=5", "clevel=7")
    assert provenance.source_digest("stereotruth.core.products.grids") != first
    edit(package / "products" / "grids.py", "clevel=7", "clevel=5")
    provenance._sources.cache_clear()
    assert provenance.source_digest("stereotruth.core.products.grids") == first
    remembered.write_text("{")
    provenance._sources.cache_clear()
    assert provenance.source_digest("stereotruth.core.products.grids") == first


def test_a_table_that_a_module_reads_changes_the_digest(package):
    first = (
        provenance.source_digest("stereotruth.core.products.grids"),
        provenance.source_digest("stereotruth.core.sheets"),
    )
    table = package / "products" / "grids.tsv"
    table.write_text("of one kind\n")
    second = provenance.source_digest("stereotruth.core.products.grids")
    table.write_text("of another\n")
    third = (
        provenance.source_digest("stereotruth.core.products.grids"),
        provenance.source_digest("stereotruth.core.sheets"),
    )
    assert len({first[0], second, third[0]}) == 3
    assert first[1] == third[1]


def test_comments_and_docstrings_do_not_change_the_digest(package):
    before = provenance.source_digest("stereotruth.core.errors")
    edit(package / "errors.py", '"""The one exception', '# a remark\n"""Another wording: the one')
    # the docstring has moved behind a comment and changed
    assert provenance.source_digest("stereotruth.core.errors") == before


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
        assert not modules & set(STAGES[n + 1 :]), stage
        assert not any(module.startswith("stereocities") for module in modules), stage
        assert "stereotruth.core.sheets" not in modules


def test_the_simulator_shares_no_code_with_the_pipeline():
    modules = set(
        provenance.source_modules("stereocities.render", "stereocities.lidar", "stereocities.truth")
    )
    assert not modules & {
        *STAGES,
        "stereotruth.sensor.rpc",
        "stereotruth.epipolar.model",
        "stereotruth.labels.view_geometry",
    }


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
    assert len(provenance.source_digest("stereotruth.core.errors")) == 16
