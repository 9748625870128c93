"""One job at a time makes a product, of inputs that stay as they are."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products import making as module
from stereotruth.core.products.files import atomic_file
from stereotruth.core.products.making import (
    Checksums,
    FileLock,
    begin_notes,
    checksum,
    exclusive,
    making,
    marks,
    marks_of_inputs,
    noted,
    refuse_replaced,
    stamp,
)

SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def file(tmp_path, monkeypatch) -> Path:
    """As written an hour ago; the time of change stays that of now."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.csv"
    path.write_text("1,2")
    then = path.stat().st_mtime - 3600
    os.utime(path, (then, then))
    return path


def in_place(path: Path) -> None:
    """Another content of the same size, and the old time of writing."""
    then = path.stat()
    with path.open("r+") as stream:
        stream.write("3")
    os.utime(path, ns=(then.st_atime_ns, then.st_mtime_ns))


def replaced(path: Path) -> None:
    """The same content by another file."""
    new = path.with_name("new")
    new.write_bytes(path.read_bytes())
    os.utime(new, ns=(0, path.stat().st_mtime_ns))
    new.replace(path)


def appended(path: Path) -> None:
    with path.open("a") as stream:
        stream.write("4")


@pytest.mark.parametrize("change", [in_place, replaced, appended])
def test_a_change_shows_in_the_stamp_however_it_was_made(file, change):
    before = stamp(file)
    assert stamp(file) == before
    change(file)
    assert stamp(file) != before


def test_all_files_of_a_folder_count_but_for_hidden_ones_and_what_runs_write(file, tmp_path):
    """Also those behind links, once each."""
    folder = tmp_path / "pairs"
    for name in ("pairs/a/1", "pairs/b/1", "pairs/.work/1", "real/1", "results/1"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (folder / "loop").symlink_to(folder)
    (folder / "left").symlink_to(tmp_path / "real")
    before, around = checksum(folder), checksum(tmp_path)
    (folder / ".work/2").write_text("x")
    (folder / ".snakemake_timestamp").touch()
    (tmp_path / "results/1").write_text("other")
    assert (checksum(folder), checksum(tmp_path)) == (before, around)
    for name in ("pairs/b/1", "real/1"):
        (tmp_path / name).write_text("other")
        assert checksum(folder) != before
        (tmp_path / name).write_text(name)


def test_checksums_are_kept_for_files_that_have_not_changed(file, tmp_path, monkeypatch):
    known = Checksums(tmp_path / ".known")
    known.of(file)
    assert not known.folder.exists()  # written just now
    then = module.time.time_ns()
    monkeypatch.setattr(module.time, "time_ns", lambda: then + 10 * module.TICK_NS)
    wanted = known.of(file)
    assert wanted == checksum(file)
    monkeypatch.setattr(module, "checksum", lambda path: "computed")
    assert Checksums(known.folder).of(file) == wanted
    in_place(file)
    assert Checksums(known.folder).of(file) == "computed"
    with pytest.raises(InputError):
        known.of("/none")


@pytest.mark.parametrize("change", [replaced, appended, Path.unlink])
def test_marks_tell_files_and_folders_that_were_replaced(file, tmp_path, change):
    folder = tmp_path / "store"
    folder.mkdir()
    for path, replace in ((file, change), (folder, lambda path: path.rename(tmp_path / "away"))):
        before = marks([path])
        refuse_replaced(before)
        replace(path)
        with pytest.raises(InputError) as refused:
            refuse_replaced(before)
        assert refused.value.file == str(path)


def _hold(path: Path, held) -> None:
    with exclusive(path):
        held.set()
        time.sleep(60)


def _append(path: Path) -> None:
    """Read, wait, write: two at once would lose an entry."""
    for _ in range(20):
        with exclusive(path):
            text = path.read_text() if path.exists() else ""
            time.sleep(0.002)
            path.write_text(text + "x")


def test_a_lock_ends_with_its_process(tmp_path) -> None:
    path, held = tmp_path / "product", SPAWN.Event()
    process = SPAWN.Process(target=_hold, args=(path, held))
    process.start()
    assert held.wait(30)
    lock = FileLock(tmp_path / ".product.lock")
    assert not lock.take(path, wait=False)
    assert str(process.pid) in lock.holder
    os.kill(process.pid, signal.SIGKILL)
    process.join(30)
    assert lock.take(path, wait=False)
    lock.close()
    with exclusive(path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_writers_take_turns(tmp_path) -> None:
    path = tmp_path / "product"
    processes = [SPAWN.Process(target=_append, args=(path,)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode == 0
    assert path.read_text() == "x" * 60
    assert [p.name for p in tmp_path.iterdir()] == ["product"]


def test_a_later_job_waits_and_has_the_last_word(tmp_path):
    """The first is late, as a job of a killed run may be that was stopped."""
    product, at_work, go_on = tmp_path / "a.txt", threading.Event(), threading.Event()

    def late() -> None:
        with making([], [product]):
            at_work.set()
            go_on.wait(60)
            product.write_text("late")

    def next_one() -> None:
        with making([], [product]):
            product.write_text("next")

    threads = [threading.Thread(target=job) for job in (late, next_one)]
    threads[0].start()
    at_work.wait(60)
    threads[1].start()
    threads[1].join(0.2)
    assert threads[1].is_alive() and not product.exists()
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert product.read_text() == "next"


def test_an_input_that_is_edited_and_put_back_ends_the_job(tmp_path):
    source, product = tmp_path / "in.csv", tmp_path / "a.txt"
    source.write_text("1,2")
    with pytest.raises(InputError) as refused:  # noqa: SIM117
        with making([source], [product]), atomic_file(product) as scratch:
            assert marks_of_inputs()
            source.write_text("3,4,5")
            source.write_text("1,2")
            scratch.write_text("made of either")
    assert refused.value.file == str(source) and not marks_of_inputs()


def test_what_the_jobs_of_a_run_made_is_noted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with making([], ["before.txt"]):
        pass
    assert noted() == []  # no run has begun
    begin_notes()
    with making([], ["one.txt", "two"]):
        pass
    with pytest.raises(ValueError), making([], ["failed.txt"]):
        raise ValueError
    assert noted() == ["one.txt", "two"]
    begin_notes()
    assert noted() == []
