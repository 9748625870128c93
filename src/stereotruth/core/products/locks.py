"""One writer at a time: locks that die with the process that holds them.

Jobs of a killed run may go on for a while, and the next run would make what they make. Locks are
`flock` on files: the kernel drops them when a process ends, however it ends. On file systems
without locks work goes on with a warning.
"""

from __future__ import annotations

import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger("stereotruth")


class FileLock:
    """A lock on a file, which is made if it is missing: held alone, or shared by several."""

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self._descriptor = os.open(self.file, os.O_RDWR | os.O_CREAT, 0o666)

    def take(self, what: str | Path, *, shared: bool = False, wait: bool = True) -> bool:
        """Take the lock, or change between shared and exclusive; False if it is not free.

        ``what`` names in messages what is guarded. With ``wait`` it is waited for.
        """
        mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(self._descriptor, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                return False
            log.info("%s: waiting for %s, which is at work there", what, self.holder)
            fcntl.flock(self._descriptor, mode)
        except OSError as error:
            log.warning("%s: no file locks here (%s)", what, error.strerror)
        if not shared:
            os.ftruncate(self._descriptor, 0)
            me = f"process {os.getpid()} on {socket.gethostname()}"
            os.pwrite(self._descriptor, me.encode(), 0)
        return True

    @property
    def holder(self) -> str:
        """Who has held the lock alone last."""
        return os.pread(self._descriptor, 200, 0).decode(errors="replace") or "another process"

    @property
    def current(self) -> bool:
        """Whether the file is still the one that was opened."""
        try:
            return self.file.stat().st_ino == os.fstat(self._descriptor).st_ino
        except FileNotFoundError:
            return False

    def close(self) -> None:
        """Give the lock back."""
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)


@contextmanager
def exclusive(path: str | Path) -> Iterator[None]:
    """Be the only process that writes ``path``; wait while another one does.

    The lock file lies beside ``path`` (``.<name>.lock``) for as long as the lock is held.
    """
    path = Path(path)
    while True:
        lock = FileLock(path.with_name(f".{path.name}.lock"))
        lock.take(path)
        if lock.current:
            break
        lock.close()  # the holder before has removed its file: a lock on that one guards nothing
    try:
        yield
    finally:
        lock.file.unlink(missing_ok=True)
        lock.close()
