"""Tables that users write: what is read, with its line, and what is refused by file and remedy."""

from __future__ import annotations

from datetime import UTC, date, datetime

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.tables import Table, acquisition_time, decimal_number


def read(tmp_path, content: str | bytes, separators: str = ",;\t", ragged: bool = False) -> Table:
    file = tmp_path / "a.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    table = Table.read(file, "write id and x", separators, ragged=ragged)
    table.require(("id", "x"), ("id", "x", "more"), "write id and x")
    return table


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("id,x\nA,1.5\n", 2),
        ("\ufeffid,x\r\nA,1.5\r\n", 2),
        ("ID; X\n\n A ; 1,5", 3),
        ("id\tx\tmore\n\t\t\nA\t1,5\t\n", 3),
        ('# said: a, b\n"# x = 2",,\nid,x\n#B,2.5\nA,1.5\n', 5),
        ('id,x,more\nA,1.5,"two\nlines"\n', 3),
    ],
)
def test_forms_of_tables(tmp_path, content, line) -> None:
    table = read(tmp_path, content)
    ((number, cells),) = table.rows
    assert (number, cells["id"]) == (line, "A")
    assert table.number_of(cells, "x", number) == 1.5
    if "said" in content:
        assert table.declared == {"said": "a, b", "x": "2"}


def test_cells_at_the_end_of_a_line_may_be_left_out_where_that_is_so(tmp_path) -> None:
    table = read(tmp_path, "id,x,more\nA,1\n", ragged=True)
    assert table.rows == [(2, {"id": "A", "x": "1", "more": ""})]
    for content, ragged in (("id,x,more\nA,1\n", False), ("id,x,more\nA,1", True)):
        with pytest.raises(InputError, match=r"a\.csv: line 2 has 2 cells for 3 columns"):
            read(tmp_path, content, ragged=ragged)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "# id,x\n",
        "id\nA\n",
        "id,x,y\n",
        "id,x,x\n",
        "id,x\nA,1,5\n",
        b"\xff\xfe\0i",
        "id|x\nA|1\n",
        'id,x\n"A,1\nB,2\n',
        "id,x\n" + "A" * 200_000,
        "id,x\n" + "A,1\n" * 6_000_000,
    ],
    ids=["nothing", "remarks", "missing", "unknown", "twice", "too many", "UTF-16", "separator",
         "an open quote",
         "a long cell", "too large"],
)  # fmt: skip
def test_what_is_no_table_is_refused(tmp_path, content) -> None:
    with pytest.raises(InputError, match=r"a\.csv: ") as error:
        read(tmp_path, content, ragged=True)
    assert error.value.remedy and len(str(error.value)) < 1000


def test_a_table_that_is_not_there_and_a_number_that_is_none_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match=r"none\.csv"):
        Table.read(tmp_path / "none.csv", "")
    table = read(tmp_path, "id,x\nA,1 5\n")
    with pytest.raises(InputError, match=r"a\.csv: line 2: x '1 5'"):
        table.number_of(table.rows[0][1], "x", 2)


def test_what_counts_as_a_number() -> None:
    for text in ("0", "-0.5", "+1.25E-03", "5.", ".5", "1e5", "007"):
        assert decimal_number(text) == float(text)
    for text in ("", "1_000", "１２３", "٣", "nan", "inf", "0x10", "1,5", "1 0", "--1", "1" * 400):
        with pytest.raises(ValueError):
            decimal_number(text)


def test_times_of_images_are_in_utc():
    day = datetime(2020, 10, 25, 3, 12, 45, tzinfo=UTC)
    assert acquisition_time("2020-10-25") == date(2020, 10, 25)
    for text in ("2020-10-25T03:12:45Z", "2020-10-25 11:12:45+08:00"):
        assert acquisition_time(text) == day
    for text in ("2020-10-25T03:12:45", "25.10.2020", "2020-13-25", "2020-10-25T03:12 CST"):
        with pytest.raises(ValueError):
            acquisition_time(text)
