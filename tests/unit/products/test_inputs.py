"""Whether files are still what they were."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from stereotruth.errors import InputError
from stereotruth.products import inputs
from stereotruth.products.inputs import Checksums, Inputs, checksum, marks, refuse_replaced


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


@pytest.mark.parametrize("change", [in_place, replaced, appended, Path.unlink])
def test_a_change_is_refused_however_it_was_made(file, known, change):
    found = Inputs([file], known)
    found.refuse_changed()
    change(file)
    with pytest.raises(InputError, match=r"a\.csv: changed .* Remedy: run again"):
        found.refuse_changed()


def test_another_content_for_a_while_is_refused(file, known):
    found, content = Inputs([file], known), file.read_bytes()
    file.write_text("5,6")
    file.write_bytes(content)
    with pytest.raises(InputError):
        found.refuse_changed()


def test_rights_and_links_are_no_change(file, known):
    found = Inputs([file], known)
    file.chmod(0o600)
    os.link(file, file.with_name("link"))
    found.refuse_changed()


def test_a_change_in_the_tick_of_the_stamp_is_seen(file, known, monkeypatch):
    """The file system's clock stands still: the stamps before and after are the same."""
    then = inputs.Stamp("same", "same", True)
    monkeypatch.setattr(inputs, "stamp", lambda path: then)
    found = Inputs([file], known)
    found.refuse_changed()
    in_place(file)
    with pytest.raises(InputError):
        found.refuse_changed()


def test_all_files_of_a_folder_count_but_for_hidden_folders_and_snakemakes(tmp_path, known):
    folder = tmp_path / "pairs"
    for name in ("a/1", "a/2", "b/1", ".work/1"):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (folder / "loop").symlink_to(folder)
    before = Inputs([folder], known)
    (folder / ".work/2").write_text("x")
    (folder / ".snakemake_timestamp").touch()
    before.refuse_changed()
    (folder / "b/1").write_text("other")
    with pytest.raises(InputError):
        before.refuse_changed()


def test_files_behind_links_count(tmp_path, known):
    (tmp_path / "real").mkdir()
    (tmp_path / "real/1").write_text("1")
    (tmp_path / "pairs").mkdir()
    (tmp_path / "pairs/left").symlink_to(tmp_path / "real")
    before = checksum(tmp_path / "pairs")
    (tmp_path / "real/1").write_text("2")
    assert checksum(tmp_path / "pairs") != before


def test_a_dataset_around_the_working_directory_is_without_what_runs_write(tmp_path, known):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/a").write_text("1")
    before = Inputs([tmp_path, tmp_path / "results"], known)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/a.log").write_text("1")
    before.refuse_changed()
    (tmp_path / "results/a").write_text("22")
    with pytest.raises(InputError, match="results: changed"):  # named itself, it counts
        before.refuse_changed()


def test_checksums_are_kept_for_files_that_have_not_changed(file, known, monkeypatch):
    then = inputs.time.time_ns()
    monkeypatch.setattr(inputs.time, "time_ns", lambda: then + 10 * inputs.TICK_NS)
    wanted = known.of(file)[1]
    assert wanted == checksum(file)
    monkeypatch.setattr(inputs, "checksum", lambda path: pytest.fail("computed again"))
    assert Checksums(known.folder).of(file)[1] == wanted
    in_place(file)
    monkeypatch.setattr(inputs, "checksum", lambda path: "computed")
    assert Checksums(known.folder).of(file)[1] == "computed"


def test_checksums_of_files_just_written_are_not_kept(tmp_path, known):
    path = tmp_path / "young"
    path.write_text("1")
    known.of(path)
    assert not known.folder.exists()


def test_marks_tell_files_and_folders_that_were_replaced(file, tmp_path):
    folder = tmp_path / "store"
    folder.mkdir()
    before = marks([file, folder])
    refuse_replaced(before)
    folder.rename(tmp_path / "away")
    folder.mkdir()
    with pytest.raises(InputError, match="store: changed"):
        refuse_replaced(before)
    before = marks([file, folder])
    appended(file)
    with pytest.raises(InputError, match=r"a\.csv: changed"):
        refuse_replaced(before)
