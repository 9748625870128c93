"""Locks between processes, which go with the process that holds them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path

from stereotruth.core.products.making import FileLock, exclusive

SPAWN = multiprocessing.get_context("spawn")


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
