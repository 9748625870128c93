"""One job: its log and errors, its progress, work in a process of its own, Dask's scheduler.

Terminal and log file have the same lines.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import multiprocessing
import os
import pickle
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import InputError, install_extra, told_by_system, without_secrets

log = logging.getLogger("stereotruth")
# New objects before garbage is collected: compiling kernels makes many that stay, and walking
# through them again and again took an eighth of its time.
GARBAGE = 200_000
TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # options of glibc's mallopt(3)


@contextmanager
def job(log_file: str | Path, name: str) -> Iterator[logging.Logger]:
    """Run one job: log to terminal and file; end with one clear line where the input is at fault.

    ``name`` is the stage and the scene. InputError becomes ``<name>: error: …`` and exit status 1,
    and so does what the operating system refuses: a full disk, no permission, a file that was taken
    away (its traceback is in the log file). Anything else is a defect and keeps its traceback.
    """
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)  # parallelism belongs to Dask and Snakemake
    gc.set_threshold(GARBAGE)
    _keep_memory()
    path = Path(log_file)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # a job of an earlier run may still write into the old one
    terminal, file = logging.StreamHandler(sys.stderr), logging.FileHandler(path, "w", "utf-8")
    terminal.setFormatter(_Discreet(f"{name}: %(message)s"))
    file.setFormatter(_Discreet(f"%(asctime)s %(levelname)s {name}: %(message)s"))
    handlers = (terminal, file)
    for handler in handlers:
        log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield log
    except InputError as error:
        log.error("error: %s", error)
        raise SystemExit(1) from None
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:  # panics of libraries in Rust are no Exception
        if (told := told_by_system(error)) is None:
            log.exception("unexpected failure")
            raise
        log.error("error: %s", told)
        where = "".join(traceback.format_exception(error))
        file.handle(log.makeRecord(log.name, logging.INFO, "", 0, "%s", (where,), None))
        raise SystemExit(1) from None
    finally:
        for handler in handlers:
            log.removeHandler(handler)
            handler.close()


class _Discreet(logging.Formatter):
    """Lines, tracebacks too, whose URLs have no secrets."""

    def format(self, record: logging.LogRecord) -> str:
        return without_secrets(super().format(record))


def _keep_memory() -> None:
    """Take arrays from one heap that is kept until the job ends; where the C library is glibc.

    It would give each larger array back to the system as soon as it is freed, and pay for fresh,
    zeroed pages with the next one: an eighth of the processor time of `project`.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # another C library
        return
    for option, value in ((MMAP_MAX, 0), (TRIM_THRESHOLD, -1), (ARENA_MAX, 1)):
        mallopt(option, value)


def in_own_process(work: Callable[[], Any], file: str | Path) -> Any:
    """What ``work`` returns or raises; done by a fork of this process, which may die of ``file``.

    For decoders that damaged files can crash. The fork dies with this process, however that ends.
    Raises InputError if it dies by itself.
    """
    context = multiprocessing.get_context("fork")
    receiving, sending = context.Pipe(duplex=False)
    watched, held = os.pipe()
    process = context.Process(target=_report, args=(work, sending, watched, held))
    process.start()
    sending.close()
    os.close(watched)
    try:
        kind, value = receiving.recv()
    except EOFError:
        process.join()
        raise InputError(
            f"damaged: the decoder crashed (exit status {process.exitcode})",
            file=file,
            remedy="fetch or write the file again; if it is whole, the job may have been killed "
            "for its memory",
        ) from None
    finally:
        os.close(held)  # ends the fork, should it still be there
        process.join()
    if kind == "refused":
        raise InputError(value[0], file=value[1], remedy=value[2])
    if kind == "failed":
        raise value
    return value


def _report(work: Callable[[], Any], sending: Any, watched: int, held: int) -> None:
    """In the fork: do the work and send what comes of it."""
    os.close(held)

    def end_with_parent() -> None:
        os.read(watched, 1)  # nothing is ever written: returns when the parent is no more
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    try:
        found = "done", work()
    except InputError as error:
        found = "refused", (error.problem, error.file, error.remedy)
    except BaseException as error:
        error.add_note(traceback.format_exc())  # which does not go through a pipe
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            error = RuntimeError(traceback.format_exc())
        found = "failed", error
    sending.send(found)


def progress(items: Iterable, total: int, what: str) -> Iterator:
    """Pass items through and log about every tenth part done."""
    last = -1
    for done, item in enumerate(items, start=1):
        yield item
        tenth = done * 10 // max(total, 1)
        if tenth > last:
            last = tenth
            log.info("%s: %d of %d", what, done, total)


def block_progress(total: int, what: str, name: str = "") -> Any:
    """A Dask callback that logs about every tenth of the blocks done (local schedulers only);
    tasks count whose key begins with ``name``."""
    from dask.callbacks import Callback  # most jobs do without Dask

    done = 0

    def count(key: object, *_: object) -> None:
        nonlocal done
        if not str(key).startswith(name):
            return
        done += 1
        if done * 10 // total > (done - 1) * 10 // total:
            log.info("%s: %d of %d blocks", what, done, total)

    return Callback(posttask=count)


@contextmanager
def dask_scheduler(address: str | None, seconds: float = 30.0) -> Iterator[Any]:
    """What Dask's compute takes as its scheduler; it is waited for so many ``seconds``.

    ``address`` of a running Dask scheduler (``tcp://host:8786``), or none for threads. Its workers
    need this package and must see the files under the same paths.

    Raises InputError if nothing answers there, or if `distributed` is not installed.
    """
    if not address:
        from dask.threaded import get  # by name, Dask would import `distributed` first: 0.2 s

        yield get
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            f"dask.scheduler_address is {address}, but distributed is not installed",
            remedy=f"{install_extra('cluster')}; or set it to null",
        ) from error
    try:
        client = Client(address, timeout=seconds)
    except OSError as error:
        raise InputError(
            f"no Dask scheduler answers ({error})",
            file=address,
            remedy="start it, correct dask.scheduler_address, or set it to null",
        ) from error
    with client:
        log.info("blocks go to the Dask workers of %s", address)
        yield client
