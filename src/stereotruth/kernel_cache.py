"""Compiled kernels on disk: one file for each kernel, its arguments' types and what it computes."""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import IO, Any
from uuid import uuid4

import numba
import numpy as np
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

PACKAGE = Path(__file__).parent
log = logging.getLogger("stereotruth.compiling")
LONGEST_S = 120.0  # that another process is waited for: one whose compilation has failed holds on


class KernelCache:
    """What is compiled of one function, for Numba's dispatcher of it.

    The name of a file holds a digest of all that its code follows from, see :func:`content`. So
    nothing is ever out of date: an edit of a kernel, or of a function of another file that it
    calls, has another name; an edit of anything else compiles nothing. Of processes that need the
    same kernel at the same time one compiles it, and the others wait.
    """

    def __init__(self, function: FunctionType, options: str) -> None:
        """``options`` of the compiler: others give other code."""
        self.function = function
        self.claims: dict[Path, IO[bytes]] = {}
        self.compiler = (numba.__version__, sys.implementation.cache_tag, options)

    @property
    def cache_path(self) -> str:
        """The folder of all compiled code; Numba shows it in its statistics."""
        return str(folder())

    def load_overload(self, types: tuple, target: Any) -> CompileResult | None:
        """The compiled kernel for ``types`` of arguments; None if there is none.

        Numba's own cache first imports all that compiling needs, a third of a second in each of a
        run's jobs. What is compiled needs the runtime only.
        """
        rtsys.initialize(target)
        file = self._file(types, target.codegen())
        parts = _read(file)
        if parts is None:
            self._claim(file)
            parts = _read(file)
        if parts is None:
            _say_once()
            return None
        self._release(file)
        return CompileResult._rebuild(target, *parts)

    def save_overload(self, types: tuple, compiled: CompileResult) -> None:
        """Keep a compiled kernel, if the folder can be written to and is not full."""
        file = self._file(types, compiled.codegen)
        holds_addresses = compiled.lifted or compiled.library.has_dynamic_globals
        if not holds_addresses:
            scratch = file.with_suffix(f".{uuid4().hex}")
            with suppress(OSError):
                scratch.write_bytes(dumps(compiled._reduce()))
                scratch.replace(file)
        self._release(file)

    def _claim(self, file: Path) -> None:
        """Return when no other process compiles this, or after LONGEST_S."""
        end = time.monotonic() + LONGEST_S
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            lock = self.claims.setdefault(file, file.with_suffix(".lock").open("ab"))
            while time.monotonic() < end:
                try:
                    return fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    time.sleep(0.05)

    def _release(self, file: Path) -> None:
        if lock := self.claims.pop(file, None):
            lock.close()
            file.with_suffix(".lock").unlink(missing_ok=True)

    def _file(self, types: tuple, target: Any) -> Path:
        parts = (self.compiler, target.magic_tuple(), content(self.function), *_arguments(types))
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        return folder() / f"{name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.bin"


@cache
def _say_once() -> None:
    """Say, once in a process, what takes its time."""
    log.info("compiling, first run only")


def _read(file: Path) -> tuple | None:
    """What a compiled kernel is made again from; None if it is absent, or cut by a crash."""
    try:
        return pickle.loads(file.read_bytes())
    except (OSError, EOFError, pickle.UnpicklingError):
        return None


def content(function: FunctionType) -> str:
    """Digest of all that a function's compiled code follows from.

    These are its instructions and constants, those of all functions that it calls, in whatever
    file they stand, and the values of the globals that they name, which compiling freezes.
    Docstrings, comments, line numbers and what stands beside them do not enter.

    Raises TypeError where a global is no function, constant or named tuple: of a module or another
    class of this package, it is not known what the code takes.
    """
    digest, reached = hashlib.sha256(), [function]
    for one in reached:  # which grows
        digest.update(repr(_described(one, reached)).encode())
    return digest.hexdigest()


def _described(function: FunctionType, reached: list[FunctionType]) -> Iterable[Any]:
    """What a function is made of; what it calls joins ``reached``."""

    def value_of(value: Any) -> Any:
        value = getattr(value, "py_func", value)  # a kernel called by another
        if isinstance(value, FunctionType):
            if value not in reached:
                reached.append(value)
            return value.__module__, value.__qualname__
        if isinstance(value, type | BuiltinFunctionType | np.ufunc | ModuleType):
            home = getattr(value, "__module__", None) or value.__name__
            if home.partition(".")[0] != PACKAGE.name or _fields(value):
                return home, value.__name__, _fields(value)
        if isinstance(value, np.ndarray | np.generic):
            return value.dtype.str, value.shape, value.tobytes()
        if isinstance(value, tuple | list):
            return [value_of(one) for one in value]
        if isinstance(value, frozenset):
            return sorted(repr(value_of(one)) for one in value)
        if isinstance(value, bool | int | float | complex | str | bytes | None):
            return repr(value)
        raise TypeError(
            f"{function.__module__}.{function.__qualname__} uses {value!r}: no constant"
        )

    parts: list[Any] = [getattr(function, "enters_its_callers", False)]
    closed = [cell.cell_contents for cell in function.__closure__ or ()]
    parts += [value_of(one) for one in (*closed, *(function.__defaults__ or ()))]
    for code in _codes(function.__code__):
        constants = [one for one in code.co_consts if not isinstance(one, CodeType)]
        constants = [None if one == function.__doc__ else value_of(one) for one in constants]
        named = [function.__globals__[n] for n in code.co_names if n in function.__globals__]
        parts += [code.co_code, code.co_argcount, code.co_names, code.co_varnames, constants]
        parts += [value_of(one) for one in named]
    return parts


def _codes(code: CodeType) -> Iterator[CodeType]:
    """The code of a function and of all within it."""
    yield code
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _codes(one)


def _fields(kind: Any) -> tuple[str, ...]:
    """Names of a named tuple's fields, which compiled code knows by number."""
    return getattr(kind, "_fields", ())


def _arguments(types: Iterable[Any]) -> Iterator[str]:
    """Numba's types in words, with the fields of named tuples."""
    for one in types:
        yield str(one)
        if kind := getattr(one, "instance_class", None):
            yield f"{kind.__module__} {_fields(kind)}"
            yield from _arguments(one)


def _writable(place: Path, private: bool) -> bool:
    """Whether a folder can be made and written to; ``private``: by this user alone."""
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        facts = place.stat()
    except OSError:
        return False
    safe = facts.st_uid == os.getuid() and not facts.st_mode & 0o022
    return os.access(place, os.W_OK) and (safe or not private)


@cache
def folder() -> Path:
    """Where compiled code is kept.

    NUMBA_CACHE_DIR if that is set; else beside the package, with the user, or, where neither can
    be written to, in a temporary folder.
    """
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(named)
    if os.access(PACKAGE, os.W_OK):
        return PACKAGE / "__pycache__" / "kernels"
    with suppress(RuntimeError):  # no HOME, and no such user
        if _writable(home := Path.home() / ".cache" / "stereotruth", private=False):
            return home / "kernels"
    shared = Path(tempfile.gettempdir()) / f"stereotruth-{os.getuid()}"
    if not _writable(shared, private=True):  # others' code must not run here
        shared = Path(tempfile.mkdtemp(prefix="stereotruth-"))
    return shared / "kernels"
