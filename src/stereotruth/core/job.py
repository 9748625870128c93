"""One job: its log and errors, its progress, work in a process of its own, Dask's scheduler.

Terminal and log file have the same lines; within ``stereotruth run`` the terminal has warnings,
errors and the progress of long work only (NEWS_ONLY, which its logger sets).
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
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from .errors import InputError, install_extra, told_by_system, without_secrets

log = logging.getLogger("stereotruth")
NEWS_ONLY = "STEREOTRUTH_NEWS_ONLY"  # environment: what the terminal shows, see above
RUN_NOTES = Path(".snakemake", "stereotruth", "run")  # what jobs tell their run
FAILED = RUN_NOTES / "failed"  # errors of jobs, one file for each of their logs
NEWS_S = 20.0  # work that takes longer tells its progress
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
    with suppress(OSError):  # of an attempt before this one
        failure_file(path).unlink()
    terminal, file = logging.StreamHandler(sys.stderr), logging.FileHandler(path, "w", "utf-8")
    terminal.setFormatter(_Discreet(f"{name}: %(message)s"))
    file.setFormatter(_Discreet(f"%(asctime)s %(levelname)s {name}: %(message)s"))
    if os.environ.get(NEWS_ONLY):
        terminal.addFilter(_is_news())
    handlers = (terminal, file)
    for handler in handlers:
        log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield log
    except InputError as error:
        log.error("error: %s", error)
        _note_failure(path, f"{name}: error: {error}")
        raise SystemExit(1) from None
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:  # panics of libraries in Rust are no Exception
        if (told := told_by_system(error)) is None:
            log.exception("unexpected failure")
            last = traceback.format_exception_only(error)[-1].strip()
            _note_failure(path, f"{name}: unexpected failure: {last}. The traceback is in {path}")
            raise
        log.error("error: %s", told)
        _note_failure(path, f"{name}: error: {told}")
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


def _is_news() -> Callable[[logging.LogRecord], bool]:
    """A filter: warnings, errors, progress of long work; one job of a run tells of compiling."""

    @cache
    def tells_of_compiling() -> bool:
        try:
            (RUN_NOTES / "compiling").touch(exist_ok=False)
        except OSError as error:  # of another kind: no run of the workflow
            return not isinstance(error, FileExistsError)
        return True

    def chosen(record: logging.LogRecord) -> bool:
        if record.name == "stereotruth.compiling":
            return tells_of_compiling()
        return record.levelno >= logging.WARNING or getattr(record, "news", False)

    return chosen


def failure_file(log_file: str | Path) -> Path:
    """Has the error with which the job of a log has failed in this run, if it has told any."""
    return FAILED / str(log_file).replace("/", "+")


def _note_failure(log_file: Path, text: str) -> None:
    with suppress(OSError):  # no run of the workflow, or a full disk
        failure_file(log_file).write_text(without_secrets(text), encoding="utf-8")


def failures() -> list[str]:
    """The errors of all failed jobs of the newest run, in the order in which they ended."""
    files = sorted(FAILED.glob("*"), key=lambda file: file.stat().st_mtime_ns)
    return [file.read_text(encoding="utf-8") for file in files]


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


def in_time(seconds: float) -> str:
    """A duration in words: 40 s, 12 min, 1 h 20 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def _teller(total: int, what: str, unit: str = "") -> Callable[[int], None]:
    """Logs, of so many parts done, each tenth, and how long the rest will take at this pace."""
    began, total = time.monotonic(), max(total, 1)

    def tell(done: int) -> None:
        if done * 10 // total > (done - 1) * 10 // total:
            passed = time.monotonic() - began
            left = in_time(passed / done * (total - done))
            more = f", about {left} left" if passed > NEWS_S and done < total else ""
            text = f"{what}: {done} of {total}{unit}{more}"
            log.info("%s", text, extra={"news": bool(more)})

    return tell


def progress(items: Iterable, total: int, what: str) -> Iterator:
    """Pass items through and log about every tenth part done."""
    tell = _teller(total, what)
    for done, item in enumerate(items, start=1):
        yield item
        tell(done)


def block_progress(total: int, what: str, name: str = "") -> Any:
    """A Dask callback that logs about every tenth of the blocks done (local schedulers only);
    tasks count whose key begins with ``name``."""
    from dask.callbacks import Callback  # most jobs do without Dask

    done, tell = 0, _teller(total, what, " blocks")

    def count(key: object, *_: object) -> None:
        nonlocal done
        if str(key).startswith(name):
            done += 1
            tell(done)

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
