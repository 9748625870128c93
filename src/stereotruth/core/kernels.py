"""How numerics are compiled, in one place: loops that Python calls, and functions within them.

Numba keeps compiled code on disk, and knows it by the source file of the kernel alone. A kernel
also follows from what its module imports, so each state of these sources has a folder of its own:
after an edit of any of them the kernel is compiled again, and old code is never taken for new.

Kernels are compiled for the processors of :data:`TARGET` wherever the machine is one of them. So
the nodes of a cluster share them, and a wheel or a container brings them along.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import math
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import IO

from llvmlite.binding import get_host_cpu_features
from numba import config, njit
from numba.core.caching import UserProvidedCacheLocator
from numba.core.event import Event, Listener, register
from numba.extending import register_jitable

log = logging.getLogger("stereotruth.compiling")
TELL_S = 20.0  # between lines that tell how far compiling is
PACKAGE = Path(__file__).parent
SHIPPED = PACKAGE / "compiled"
"""Kernels that a wheel brings along (``make wheel``)."""

TARGET = "x86-64-v3"
_OF_TARGET = {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"}
_OF_HOST = {name for name, there in get_host_cpu_features().items() if there}
if config.CPU_NAME is None and config.CPU_FEATURES is None and _OF_HOST >= _OF_TARGET:
    config.CPU_NAME, config.CPU_FEATURES = TARGET, ""
_OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True}
if config.BOUNDSCHECK:  # NUMBA_BOUNDSCHECK=1: kernels refuse indices out of bounds
    _OPTIONS["boundscheck"] = True
_IMPORT = re.compile(  # at the start of a line: what a function imports, no kernel can call
    r"^(?:from\s+([.\w]+)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+([^\n]+))", re.MULTILINE
)

_kernels: set[Callable] = set()

inner: Callable = register_jitable(**_OPTIONS)
"""A function that kernels call; plain Python where Python calls it.

It is compiled within its kernels: without a door for Python, and once for all constants of a type.
"""

inlined: Callable = register_jitable(forceinline=True, _nrt=False, **_OPTIONS)
"""An inner function whose code enters its callers', and that allocates nothing.

Without reference counting of the arrays that it looks at: counting took two thirds of the time of
the simulator's rays (1000 against 290 ns a ray, textures and shadows included).
"""


class KernelLocator(UserProvidedCacheLocator):
    """Tells Numba where a kernel is kept: the same place wherever the package is installed."""

    def __init__(self, function: FunctionType, file: str) -> None:
        super().__init__(function, file)
        self._folder = config.CACHE_DIR

    def get_cache_path(self) -> str:
        """The folder of the kernel's sources."""
        return self._folder


def kernel(function: Callable) -> Callable:
    """A compiled loop over points or pixels, which Python calls."""
    _kernels.add(function)
    named = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
    config.CACHE_DIR = str(_kept(sources_digest(function.__module__)))
    config.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__}"
    try:
        return njit(nogil=True, cache=True, **_OPTIONS)(function)
    finally:
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = named


def _kept(digest: str) -> Path:
    """The folder of the kernels of some sources; those that the wheel brought are copied there."""
    place, shipped = folder() / digest, SHIPPED / digest
    if shipped.is_dir() and not place.exists():
        place.parent.mkdir(exist_ok=True)
        scratch = tempfile.mkdtemp(dir=place.parent)
        shutil.copytree(shipped, scratch, dirs_exist_ok=True)
        try:
            Path(scratch).rename(place)
        except OSError:  # another process was first
            shutil.rmtree(scratch)
    return place


def source_modules(module: str) -> list[str]:
    """An imported module and all that it imports of its package and of this one, sorted."""
    seen, todo = set(), [module]
    while todo:
        if (name := todo.pop()) not in seen:
            seen.add(name)
            todo += _source(name)[1]
    return sorted(seen)


def sources_digest(module: str) -> str:
    """Digest of all that the kernels of a module follow from: sources and compiler's options."""
    digest = hashlib.sha256(repr(_OPTIONS).encode())
    for name in source_modules(module):
        digest.update(name.encode() + _source(name)[0])
    return digest.hexdigest()[:32]


@cache
def _source(module: str) -> tuple[bytes, list[str]]:
    """Digest of a module's file, and the modules that it imports from packages known here."""
    file = Path(sys.modules[module].__file__)
    text = file.read_bytes()
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    roots = {module.partition(".")[0], __package__.partition(".")[0]}
    names = {name for name in _imported(text.decode(), package) if name.partition(".")[0] in roots}
    return hashlib.sha256(text).digest(), sorted(names & set(sys.modules))


def _imported(text: str, package: str) -> Iterator[str]:
    """Full names of all that a source imports, of modules and of what stands in them."""
    for base, names, plain in _IMPORT.findall(text):
        if plain:
            yield from re.findall(r"[\w.]+", plain)
            continue
        inner_name = base.lstrip(".")
        if level := len(base) - len(inner_name):
            parents = package.split(".")
            parents = parents[: len(parents) - level + 1]
            base = ".".join([*parents, *([inner_name] if inner_name else [])])
        yield base
        yield from (f"{base}.{name}" for name in re.findall(r"\w+", names))


@cache
def folder() -> Path:
    """Where compiled code is kept: the first of these that can be written to.

    NUMBA_CACHE_DIR, beside the package, the user's cache, a temporary folder of the user's own.
    """
    places = [PACKAGE / "__pycache__"]
    with suppress(RuntimeError):  # no HOME, and no such user
        places.append(Path.home() / ".cache" / "stereotruth")
    if config.CACHE_DIR:
        places.insert(0, Path(config.CACHE_DIR))
    for place in places:
        with suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=place).close()
            return place / "kernels"
    place = Path(tempfile.gettempdir()) / f"stereotruth-{os.getuid()}"
    place.mkdir(mode=0o700, exist_ok=True)
    facts = place.stat()
    if facts.st_uid != os.getuid() or facts.st_mode & 0o022:  # others' code must not run here
        place = Path(tempfile.mkdtemp(prefix="stereotruth-"))
    return place / "kernels"


class _Compilation(Listener):
    """Says that kernels are compiled, and lets one process at a time keep what it compiled.

    Numba writes a kernel's index and its code one after the other. Of two processes that compiled
    it for different types, one would lose its entry, or have it stand for the other's code.
    """

    def __init__(self) -> None:
        self.count, self.told_at = 0, -math.inf
        self.thread = threading.local()

    def on_start(self, event: Event) -> None:
        """Numba asks for its lock, within which it loads, compiles and keeps; or it compiles."""
        if event.kind == "numba:compiler_lock":
            self.thread.depth = getattr(self.thread, "depth", 0) + 1
            return
        self.count += 1
        if time.monotonic() - self.told_at > TELL_S:
            done = f": {self.count - 1} functions so far" if self.count > 1 else ""
            log.info("compiling, once%s", done)
            self.told_at = time.monotonic()

    def on_end(self, event: Event) -> None:
        """A kernel is compiled and will be kept; or it was, with the outermost of Numba's locks.

        What kernels call is compiled first and not kept: claimed from then on, processes would
        compile one after the other.
        """
        if event.kind == "numba:compile":
            is_kernel = event.data["dispatcher"].py_func in _kernels
            if is_kernel and getattr(self.thread, "claim", None) is None:
                self.thread.claim = _claim()
            return
        self.thread.depth -= 1
        if self.thread.depth == 0 and getattr(self.thread, "claim", None):
            self.thread.claim.close()
            self.thread.claim = None


def _claim() -> IO[bytes] | None:
    """An open file that one process alone can hold; None where the file system has no locks."""
    with suppress(OSError):
        claim = (folder() / "lock").open("ab")
        fcntl.flock(claim, fcntl.LOCK_EX)
        return claim
    return None


_compilation = _Compilation()
register("numba:compile", _compilation)
register("numba:compiler_lock", _compilation)
