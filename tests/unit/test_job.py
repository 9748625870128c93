"""What a job says when it fails."""

from __future__ import annotations

import pytest

from stereotruth.errors import InputError
from stereotruth.job import job


def test_input_errors_are_one_line_in_any_alphabet(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("LC_ALL", "C")
    log = tmp_path / "a.log"
    with pytest.raises(SystemExit), job(log, "ingest ö"):
        raise InputError("5° − 3 × 2", file="ü.laz", remedy="→ другой")
    assert "ERROR ingest ö: error: ü.laz: 5° − 3 × 2. Remedy: → другой" in log.read_text("utf-8")


def test_panics_of_libraries_are_logged(tmp_path) -> None:
    """Those of Rust are no Exception; the log was empty."""
    panic = type("PanicException", (BaseException,), {})
    with pytest.raises(panic), job(tmp_path / "a.log", "ingest"):
        raise panic("index out of bounds")
    text = (tmp_path / "a.log").read_text("utf-8")
    assert "unexpected failure" in text
    assert "index out of bounds" in text


def test_an_interrupt_is_no_failure(tmp_path) -> None:
    with pytest.raises(KeyboardInterrupt), job(tmp_path / "a.log", "ingest"):
        raise KeyboardInterrupt
    assert (tmp_path / "a.log").read_text("utf-8") == ""
