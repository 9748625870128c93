"""Whether files are still what they were."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products import making as inputs
from stereotruth.core.products.making import Checksums, checksum, marks, refuse_replaced, stamp


@pytest.fixture
def known(tmp_path, monkeypatch) -> Checksums:
    monkeypatch.chdir(tmp_path)
    return Checksums(tmp_path / ".known")


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "a.csv"
    path.write_text("1,2")
    return old(path)


def old(path: Path) -> Path:
    """As written an hour ago; the time of change stays that of now."""
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


def test_all_files_of_a_folder_count_but_for_hidden_ones(tmp_path):
    """Also those behind links, once each."""
    folder = tmp_path / "pairs"
    for name in ("pairs/a/1", "pairs/b/1", "pairs/.work/1", "real/1"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (folder / "loop").symlink_to(folder)
    (folder / "left").symlink_to(tmp_path / "real")
    before = checksum(folder)
    (folder / ".work/2").write_text("x")
    (folder / ".snakemake_timestamp").touch()
    assert checksum(folder) == before
    for name in ("pairs/b/1", "real/1"):
        (tmp_path / name).write_text("other")
        assert checksum(folder) != before
        (tmp_path / name).write_text(name)


def test_a_dataset_around_the_working_directory_is_without_what_runs_write(tmp_path, known):
    (tmp_path / "results").mkdir()
    before = checksum(tmp_path), checksum(tmp_path / "results")
    (tmp_path / "results/a").write_text("1")
    assert checksum(tmp_path) == before[0]
    assert checksum(tmp_path / "results") != before[1]  # named itself, it counts


def test_checksums_are_kept_for_files_that_have_not_changed(file, known, monkeypatch):
    then = inputs.time.time_ns()
    monkeypatch.setattr(inputs.time, "time_ns", lambda: then + 10 * inputs.TICK_NS)
    wanted = known.of(file)
    assert wanted == checksum(file)
    monkeypatch.setattr(inputs, "checksum", lambda path: "computed")
    assert Checksums(known.folder).of(file) == wanted
    in_place(file)
    assert Checksums(known.folder).of(file) == "computed"


def test_checksums_of_files_just_written_are_not_kept(tmp_path, known):
    path = tmp_path / "young"
    path.write_text("1")
    known.of(path)
    assert not known.folder.exists()


def test_a_file_that_cannot_be_read_is_refused(known):
    with pytest.raises(InputError, match=r"/none: cannot be read.*Remedy"):
        known.of("/none")


@pytest.mark.parametrize("change", [replaced, appended, Path.unlink])
def test_marks_tell_files_that_were_replaced(file, change):
    before = marks([file])
    refuse_replaced(before)
    change(file)
    with pytest.raises(InputError, match=r"a\.csv: changed .* Remedy: run again"):
        refuse_replaced(before)


def test_marks_tell_folders_that_were_replaced(tmp_path):
    folder = tmp_path / "store"
    folder.mkdir()
    before = marks([folder])
    (folder / "1").write_text("looked at")
    refuse_replaced(before)
    folder.rename(tmp_path / "away")
    folder.mkdir()
    with pytest.raises(InputError, match="store: changed"):
        refuse_replaced(before)
