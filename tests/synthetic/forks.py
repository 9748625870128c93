"""Programs forked by a process that has imported what they need and has no threads.

A fork has the locks that other threads hold, and waits for them for ever. Processes with threads,
as the tests' and Snakemake's, therefore ask a process without any.
"""

from __future__ import annotations

import atexit
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
MOST = 1 << 17  # bytes of a call
Act = Callable[[Any], None]


class Fork:
    """A process that was asked for."""

    def __init__(self, answers: int) -> None:
        self._answers = os.fdopen(answers)
        self.pid = int(self._answers.readline())
        self.returncode: int | None = None
        self._ready = selectors.DefaultSelector()
        self._ready.register(answers, selectors.EVENT_READ)

    def poll(self) -> int | None:
        """Its exit status if it has ended; 1 if what forked it has ended before."""
        return self._end() if self.returncode is None and self._ready.select(0) else self.returncode

    def wait(self, seconds: float | None = None) -> int:
        """Its exit status; raises TimeoutError, and ends its session, after so many seconds."""
        if self.returncode is None and not self._ready.select(seconds):
            os.killpg(self.pid, signal.SIGKILL)
            raise TimeoutError(f"process {self.pid} is at work after {seconds:.0f} s")
        return self._end() if self.returncode is None else self.returncode

    def _end(self) -> int:
        self.returncode = int(self._answers.readline() or 1)
        self._ready.close()
        self._answers.close()
        return self.returncode


class Forker:
    """Asks a process to fork; may be called by any thread."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def ask(self, call: Any) -> Fork:
        """A new process that does what the call says."""
        answers, told = os.pipe()
        try:
            socket.send_fds(self._end, [json.dumps(call).encode()], [told])
        finally:
            os.close(told)
        return Fork(answers)

    def close(self) -> None:
        self._end.close()


def start(module: str, *arguments: str) -> Forker:
    """A process of its own that runs a module, which serves the socket of :func:`given`."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    there.set_inheritable(True)
    command = [sys.executable, "-m", module, str(there.fileno()), *arguments]
    process = subprocess.Popen(command, cwd=ROOT, pass_fds=[there.fileno()])
    there.close()
    atexit.register(process.wait)
    atexit.register(here.close)  # before the wait, which it ends
    return Forker(here)


def given() -> socket.socket:
    """The socket that this process, which :func:`start` has started, has to serve."""
    return socket.socket(fileno=int(sys.argv[1]))


def fork(act: Act) -> Forker:
    """A forked process that forks; for processes that have no threads yet."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if not os.fork():
        here.close()
        try:
            serve(there, act)
        finally:
            os._exit(0)
    there.close()
    return Forker(here)


def serve(end: socket.socket, act: Act) -> None:
    """Fork a process for each call, which does ``act``, until nobody is left to ask."""
    selector = selectors.DefaultSelector()
    selector.register(end, selectors.EVENT_READ)
    while True:
        for key, _ in selector.select():
            if key.fileobj is end:
                call, told, *_ = socket.recv_fds(end, MOST, 1)
                if not call:
                    return
                pid = os.fork()
                if not pid:
                    _do(act, call)
                _tell(told[0], pid)
                selector.register(os.pidfd_open(pid), selectors.EVENT_READ, (pid, told[0]))
            else:
                pid, told = key.data
                selector.unregister(key.fd)
                os.close(key.fd)
                _tell(told, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
                os.close(told)


def _tell(told: int, number: int) -> None:
    with suppress(BrokenPipeError):  # who has asked is killed
        os.write(told, f"{number}\n".encode())


def _let_go_of_files() -> None:
    """Close all files but the streams; each descriptor leads to /dev/null from then on.

    PROJ closes the descriptor of its database as soon as it notices the fork. A descriptor that is
    free by then would be that of a file opened since, such as the log of a job.
    """
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in [int(file.name) for file in Path("/dev/fd").iterdir()]:
        if number > 2:
            with suppress(OSError):  # that of the list itself
                os.fstat(number)
                os.dup2(nothing, number)


def _do(act: Act, call: bytes) -> None:
    """Do what a call says, as a program that begins would: with no files but its streams."""
    status = 1
    try:
        _let_go_of_files()
        act(json.loads(call))
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
