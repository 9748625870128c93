"""Files that are whole or absent, tables that no spreadsheet runs, and names that others state."""

from __future__ import annotations

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import (
    LONGEST_NAME,
    atomic_file,
    path_below,
    plain_name,
    read_table,
    write_table,
)

FORMULAS = ("=1+1", "+A1", "-2+3", "@SUM(A1)", "\tx", "=HYPERLINK(1)", "-", "'=1", "''-x")
OTHERS = ("QC_1", "'", "'a", "", "a=b", "1.5", "-1.5", "+7", "-1e-3", "-inf", "nan")


def test_texts_come_back_as_they_were_and_no_cell_begins_as_a_formula(tmp_path):
    texts = [*FORMULAS, *OTHERS]
    write_table(tmp_path / "a.csv", [{"name": text, "n": 1} for text in texts])
    rows = list(read_table(tmp_path / "a.csv"))
    assert rows == [{"name": text, "n": "1"} for text in texts]
    lines = (tmp_path / "a.csv").read_text().splitlines()[1 : 1 + len(FORMULAS)]
    assert all(line.lstrip('"').startswith("'") for line in lines)
    write_table(tmp_path / "b.csv", [{"a": -1.5, "b": "-1.5", "c": -3, "d": None}])
    assert (tmp_path / "b.csv").read_text() == "a,b,c,d\n-1.5,-1.5,-3,\n"  # numbers stay numbers


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "a.json"
    with atomic_file(path) as scratch:
        scratch.write_text("{}")
        assert scratch.suffix == ".json" and not path.exists()
    with pytest.raises(RuntimeError), atomic_file(path) as scratch:
        scratch.write_text("half")
        raise RuntimeError
    assert path.read_text() == "{}"
    assert list(path.parent.iterdir()) == [path]


OUTSIDE = ("/etc/x", "../../../../x", "..", ".", ".x", "a\\b", "C:\\x", "a\0b", "a\nb")


def test_names_that_lead_elsewhere_are_refused():
    for name in (*OUTSIDE, "a/b", "", "x" * (LONGEST_NAME + 1), "é" * 51, "a\udce9", 7):
        with pytest.raises(InputError) as refused:
            plain_name(name, "line 2: tile", "m.csv")
        assert str(refused.value).isprintable() and len(str(refused.value)) < 400
    for path in (*OUTSIDE, "a//b", "a/../b", "a/", "", None, "a/" * 600):
        with pytest.raises(InputError):
            path_below(path, "line 2: left", "m.csv")
    for name in ("QC_1", "a b", "é", "-1", "=1+2", "$frac$", "x" * 100):
        assert plain_name(name, "tile", "m.csv") == name
    path = "with ground truth/train/left/QC_left_1.tiff"
    assert path_below(path, "left", "m.csv") == path
