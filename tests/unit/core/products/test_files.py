"""Tables: what spreadsheets would run is text in them, and comes back as it was."""

from __future__ import annotations

import pytest

from stereotruth.core.products.files import read_table, write_table

FORMULAS = ("=1+1", "+A1", "-2+3", "@SUM(A1)", "\tx", "=HYPERLINK(1)", "-", "'=1", "''-x")
OTHERS = ("QC_1", "'", "'a", "", "a=b", "1.5", "-1.5", "+7", "-1e-3", "-inf", "nan")


@pytest.mark.parametrize("text", [*FORMULAS, *OTHERS])
def test_texts_come_back_as_they_were(tmp_path, text):
    write_table(tmp_path / "a.csv", [{"name": text, "n": 1}])
    (row,) = read_table(tmp_path / "a.csv")
    assert row == {"name": text, "n": "1"}


def test_no_cell_begins_as_a_formula(tmp_path):
    write_table(tmp_path / "a.csv", [{"name": text} for text in FORMULAS])
    lines = (tmp_path / "a.csv").read_text().splitlines()[1:]
    assert len(lines) == len(FORMULAS)
    assert all(line.lstrip('"').startswith("'") for line in lines)


def test_numbers_stay_numbers(tmp_path):
    write_table(tmp_path / "a.csv", [{"a": -1.5, "b": "-1.5", "c": -3, "d": None}])
    assert (tmp_path / "a.csv").read_text() == "a,b,c,d\n-1.5,-1.5,-3,\n"
