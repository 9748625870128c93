"""What a job says when it fails."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.job import failures, in_own_process, job, progress
from stereotruth.core.products.making import begin_notes


def test_input_errors_are_one_line_in_any_alphabet(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("LC_ALL", "C")
    log = tmp_path / "a.log"
    with pytest.raises(SystemExit), job(log, "ingest ö"):
        raise InputError("5° − 3 × 2", file="ü.laz", remedy="→ другой")
    assert "ERROR ingest ö: error: ü.laz: 5° − 3 × 2. Remedy: → другой" in log.read_text("utf-8")


def test_a_file_that_is_taken_away_is_one_sentence(tmp_path, capsys) -> None:
    log = tmp_path / "a.log"
    with pytest.raises(SystemExit), job(log, "refine"):
        (tmp_path / "left.zarr").read_bytes()
    line = f"refine: error: {tmp_path / 'left.zarr'}: no such file: it was there"
    assert line in capsys.readouterr().err.splitlines()[0]
    text = log.read_text("utf-8")
    assert f"ERROR {line}" in text and "Traceback" in text  # for whoever looks for a defect


def test_a_defect_is_logged_without_secrets_of_urls(tmp_path, capsys) -> None:
    """Panics of libraries in Rust are no Exception."""
    log = tmp_path / "a.log"
    with pytest.raises(BaseException, match="host"), job(log, "ingest") as lines:
        lines.info("reads https://me:hunter2@host/a")
        raise type("PanicException", (BaseException,), {})("https://host/a?X-Amz-Signature=hunter2")
    said = capsys.readouterr().err
    assert "hunter2" not in log.read_text("utf-8") + said and said.count("host/a") >= 2
    assert "unexpected failure" in log.read_text("utf-8")


def test_work_in_a_process_of_its_own_returns_and_raises(tmp_path) -> None:
    assert in_own_process(lambda: {"a": [1]}, "a.laz") == {"a": [1]}

    def refuse():
        raise InputError("is wrong", file="b.laz", remedy="mend it")

    with pytest.raises(InputError, match=r"b.laz: is wrong. Remedy: mend it"):
        in_own_process(refuse, "a.laz")
    with pytest.raises(OSError, match="full") as error:
        in_own_process(lambda: os.write(3, (_ for _ in ()).throw(OSError(28, "full"))), "a.laz")
    assert error.value.errno == 28
    assert "Traceback" in error.value.__notes__[0]


def test_a_crash_of_that_process_is_a_refusal() -> None:
    """Some damaged LAZ files crash lazrs."""
    with pytest.raises(InputError, match=r"a.laz: damaged: the decoder crashed .*-9"):
        in_own_process(lambda: os.kill(os.getpid(), signal.SIGKILL), "a.laz")


def test_that_process_ends_with_its_parent(tmp_path) -> None:
    """A job that was killed must not publish later."""
    file = tmp_path / "pid"
    script = (
        "import os, time, pathlib; from stereotruth.core.job import in_own_process\n"
        f"file = pathlib.Path({str(file)!r})\n"
        "def work():\n    file.with_suffix('.new').write_text(str(os.getpid()))\n"
        "    file.with_suffix('.new').rename(file)\n    time.sleep(100)\n"
        "in_own_process(work, 'a.laz')"
    )
    parent = subprocess.Popen([sys.executable, "-c", script])
    while not file.exists():
        assert parent.poll() is None
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    for _ in range(400):
        state = Path(f"/proc/{file.read_text()}/stat")
        if not state.exists() or state.read_text().split(") ")[1][0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("it is still there")


def test_the_errors_of_failed_jobs_are_kept_whole_until_they_succeed(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    begin_notes()
    with pytest.raises(SystemExit), job("logs/match.log", "match a"):
        raise InputError("ended with status 3:\nno weights", remedy="mend it")
    with pytest.raises(NameError), job("logs/export.log", "export a"):
        raise NameError("name x is not defined")
    assert failures() == [
        "match a: error: ended with status 3:\nno weights. Remedy: mend it",
        "export a: unexpected failure: NameError: name x is not defined. The traceback is in "
        "logs/export.log",
    ]
    with job("logs/match.log", "match a"):
        pass
    assert len(failures()) == 1


def test_long_work_says_how_long_it_will_take(tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setattr("stereotruth.core.job.NEWS_S", -1.0)
    caplog.set_level("INFO", "stereotruth")
    assert list(progress(range(10), 10, "tiles")) == list(range(10))
    assert [record.news for record in caplog.records] == [True] * 9 + [False]
    assert "5 of 10, about" in caplog.messages[4]
