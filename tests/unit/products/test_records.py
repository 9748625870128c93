"""Records of what products were made of."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth.products import records


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    records._checksum.cache_clear()
    records._checksums.cache_clear()
    return tmp_path


def test_records_lie_in_the_results_by_the_name_of_the_product(here):
    records.write_record("tiles/A", {"made": "x", "inputs": {}})
    assert records.read_record(here / "tiles/A") == {"made": "x", "inputs": {}}
    assert records.record_file("tiles/A").is_relative_to("results")
    assert records.read_record("tiles/B") == {}
    records.write_record("../elsewhere/a.json", {"made": "y"})  # not ended: among none
    assert records.read_record("../elsewhere/a.json") == {"made": "y"}
    assert [record["made"] for record in records.all_records()] == ["x"]


def test_inputs_that_changed_are_told_and_missing_ones_are_not(here):
    Path("a").write_text("1")
    Path("b").write_text("1")
    one = records._checksum("a")
    record = {"inputs": {"a": one, "b": "other", "gone": one}}
    assert records.changed_inputs(record) == {"b": one}
