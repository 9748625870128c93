"""Stereo methods of the user's own: a program, or a function; and the maps that programs write.

config/README.md says what a program (kind ``command``) is told and what it writes, and which
functions are taken (kind ``function``).

The results of a program that fails are kept but for the last, which may be half written. The
seconds of a pair are those of its call, with the start of the program; with ``pairs: file`` they
are the time between its result and that of the row before. Memory is that of the program and of
those that it started, looked at every ``POLL_SECONDS``; programs in containers of a daemon (Docker)
are not seen.

What a function names may be an object with ``scaling`` and ``margin_px``, which is taken for a
:class:`.matcher.Matcher` as it is; of a class, the options make the object.
"""

from __future__ import annotations

import csv
import importlib.util
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import psutil
from numpy.typing import NDArray

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_disparity, refuse_large

from .kinds import place_of, words_of
from .matcher import DisparityRange, ImagePair, Matched, Matcher, UncertainMatcher, called

MARGIN_PX = 128  # of a program or function that states none
MOST_PAIRS = 256  # of one call: their images lie in the temporary folder
POLL_SECONDS = 0.05
TAIL_LINES, TAIL_CHARACTERS = 20, 2000  # of the program's output, in messages
MB = 1 << 20
NEEDED = {"each": ("{left}", "{right}", "{out}"), "file": ("{pairs}",)}
SUFFIXES = (".tif", ".tiff", ".npy", ".pfm")
LONGEST_LINE = 100  # of the header of a portable float map


def read_result(file: Path, nodata: float = np.nan) -> NDArray[np.float32]:
    """A disparity map, float32[h, w] px; NaN where it is nodata (given or tagged) or not finite.

    Raises InputError if it cannot be read.
    """
    if file.suffix in (".tif", ".tiff"):
        return read_disparity(file, nodata)
    try:
        if file.suffix == ".npy":  # no objects, and no larger than the file
            values = np.lib.format.open_memmap(file, mode="r")
            refuse_large(values.shape, file)
        else:
            values = _pfm(file)
        values = values.astype(np.float32)
    except InputError:
        raise
    except (OSError, ValueError, TypeError, EOFError, IndexError):
        raise InputError("no image that can be read", file=file, remedy="write it anew") from None
    values[~np.isfinite(values) | (values == np.float32(nodata))] = np.nan
    return values


def _pfm(file: Path) -> NDArray[Any]:
    """A portable float map, whose rows run upwards; its scale tells the order of bytes alone."""
    with file.open("rb") as stream:
        kind, size, scale = (stream.readline(LONGEST_LINE).split() for _ in range(3))
        cols, rows = map(int, size)
        refuse_large((rows, cols), file)
        is_map = kind == [b"Pf"] and min(rows, cols) > 0 and float(scale[0])
        if not is_map or file.stat().st_size < 4 * rows * cols:
            raise ValueError("no map of one band, as large as its header says")
        data = stream.read(4 * rows * cols)
    values = np.frombuffer(data, "<f4" if float(scale[0]) < 0 else ">f4", rows * cols)
    return values.reshape(rows, cols)[::-1]


class CommandMethod(UncertainMatcher):
    """A program as a Matcher, also of many pairs; see the module."""

    device = "a program of its own"

    def __init__(
        self,
        *,
        name: str,
        command: str,
        pairs: str = "each",
        suffix: str = ".tif",
        uncertainty: bool = False,
        files: Sequence[str] = (),
        margin_px: int = MARGIN_PX,
        workers: int = 1,
    ) -> None:
        for key, value, known in (("pairs", pairs, tuple(NEEDED)), ("suffix", suffix, SUFFIXES)):
            if value not in known:
                raise InputError(
                    f"method {name!r}: {key} is {value!r}",
                    remedy=f"take one of {', '.join(known)}",
                )
        needed = NEEDED[pairs]
        if uncertainty and pairs == "each":
            needed += ("{uncertainty}",)
        if lacking := [word for word in needed if word not in command]:
            raise InputError(
                f"method {name!r}: its command has no {', '.join(lacking)}",
                remedy=f"write where the program is told of {' '.join(needed)}",
            )
        self.margin_px = margin_px
        self._name, self._words, self._suffix = name, words_of(command), suffix
        self._at_once = MOST_PAIRS if pairs == "file" else 1
        self._workers = workers
        self._columns = ("left", "right", "out", *(("uncertainty",) if uncertainty else ()))

    def scaling(self, left: Any, right: Any) -> None:
        """None: nothing is known of what the program does."""

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The program's disparity, and its standard uncertainty if it writes one."""
        (found,) = self.many([ImagePair("pair", left, right)], disparity_range)
        return found.disparity, found.uncertainty

    def many(
        self, pairs: Iterable[ImagePair], disparity_range: DisparityRange
    ) -> Iterator[Matched]:
        """The results of pairs of images, in their order.

        Raises InputError if the program fails, when those that it had finished are given.
        """
        pairs = iter(pairs)
        while some := list(islice(pairs, self._at_once)):
            with TemporaryDirectory(prefix="stereotruth-") as folder:
                rows = [self._written(Path(folder), pair) for pair in some]
                asked = {pair.name: pair.left.shape[:2] for pair in some}
                del some
                yield from self._results(Path(folder), asked, rows, disparity_range)

    def _written(self, folder: Path, pair: ImagePair) -> list[Path]:
        """The files of a pair: images, which are written, and results."""
        import cv2  # slow to import, and who reads results needs none

        ends = ("left.tif", "right.tif", f"disparity{self._suffix}", f"uncertainty{self._suffix}")
        files = [folder / f"{pair.name}_{end}" for end in ends[: len(self._columns)]]
        for file, image in zip(files, (pair.left, pair.right)):
            if image.ndim == 3:
                image = np.ascontiguousarray(image[..., ::-1])  # OpenCV has blue first
            cv2.imwrite(str(file), image)
        return files

    def _results(
        self,
        folder: Path,
        asked: Mapping[str, tuple[int, int]],
        rows: Sequence[list[Path]],
        disparity_range: DisparityRange,
    ) -> Iterator[Matched]:
        """Call the program for the pairs ``asked`` (names and sizes), and read what it wrote."""
        table, output = folder / "pairs.csv", folder / "output.txt"
        with table.open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerows(rows)
        low, high = disparity_range
        values = dict(zip(self._columns, rows[0]), pairs=table, low=low, high=high)
        values["threads"] = self._workers
        words = [  # a value is not read again
            re.sub(r"\{(\w+)\}", lambda found: str(values.get(found[1], found[0])), word)
            for word in self._words
        ]
        before = time.time()
        try:
            ended = _run(words, output)
        except OSError as error:
            raise InputError(
                f"method {self._name!r}: cannot start {words[0]}: {error.strerror}",
                remedy="name a program that is there and can be run",
            ) from None
        begun = [any(out.exists() for out in row[2:]) for row in rows]
        last_begun = max((k for k, is_begun in enumerate(begun) if is_begun), default=0)
        for k, ((name, shape), row) in enumerate(zip(asked.items(), rows)):
            if ended.status and (k >= last_begun or not all(out.is_file() for out in row[2:])):
                how = f"status {ended.status}" if ended.status > 0 else f"signal {-ended.status}"
                at = begun.index(False) if False in begun else -1
                raise self._failure(f"ended with {how}", list(asked)[at], words, output)
            for what, out in zip(("disparities", "uncertainty"), row[2:]):
                if not out.is_file():
                    raise self._failure(f"wrote no {what} of pair {name}", name, words, output)
            written = max(out.stat().st_mtime for out in row[2:])
            seconds = max(written - before, 0.0) if len(rows) > 1 else ended.seconds
            before = max(written, before)
            maps = [read_result(out) for out in row[2:]]
            for found in maps:
                if found.shape != shape:
                    what = f"wrote disparities of {found.shape} px for images of {shape}"
                    raise self._failure(what, name, words, output)
            yield Matched(maps[0], seconds, ended.memory_mb, *maps[1:])

    def _failure(self, what: str, pair: str, words: Sequence[str], output: Path) -> InputError:
        """What went wrong at a pair, with the end of the program's output."""
        text = output.read_text(encoding="utf-8", errors="replace")
        lines = text[-TAIL_CHARACTERS:].splitlines()[-TAIL_LINES:]
        said = "its output ends with:\n" + "\n".join(lines) if lines else "it said nothing"
        return InputError(
            f"method {self._name!r}, pair {pair}: the program {what}; {said}\n"
            f"It was called by: {shlex.join(words)}",
            remedy="mend the program or its command and run again; finished pairs are kept",
        )


class _Ended(NamedTuple):
    """Exit status of a program, its seconds, and peak memory in MB (None: not known)."""

    status: int
    seconds: float
    memory_mb: float | None


def _run(words: Sequence[str], output: Path) -> _Ended:
    """Run a program to its end; it, and what it started, ends with the caller.

    Waits by psutil: an exception of a signal handler within ``subprocess.Popen.wait`` may leave a
    lock of it held (CPython 3.11), for which the wait after the kill would wait for ever.
    """
    start, most = time.perf_counter(), 0
    status: int | None = None
    with output.open("wb") as stream:
        process = psutil.Popen(
            words, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT
        )
    try:
        while True:
            held = 0
            with suppress(psutil.Error):
                for each in (process, *process.children(recursive=True)):
                    with suppress(psutil.Error):
                        held += each.memory_info().rss
            most = max(most, held)
            with suppress(psutil.TimeoutExpired):
                status = process.wait(POLL_SECONDS) or 0  # none where the system keeps none
                break
    finally:
        if status is None:
            with suppress(psutil.Error):
                for each in process.children(recursive=True):
                    with suppress(psutil.Error):
                        each.kill()
            with suppress(psutil.Error):
                process.kill()
            process.wait()
    memory_mb = round(most / MB, 1) if most else None
    return _Ended(status, time.perf_counter() - start, memory_mb)


class FunctionMethod(UncertainMatcher):
    """A plain function ``(left, right, disparity_range) -> disparity`` as a Matcher.

    It may return a tuple of the disparity and its standard uncertainty.
    """

    def __init__(
        self, function: Callable[..., Any], margin_px: int = MARGIN_PX, name: str = "function"
    ) -> None:
        self.function = function
        self.margin_px = margin_px
        self.name = name

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The function's disparity, and its standard uncertainty if the function states one.

        Raises InputError if one of them is none of the images' size.
        """
        found = self.function(left, right, disparity_range)
        if not isinstance(found, tuple):
            return self._map(found, left), None
        if len(found) != 2:
            raise InputError(
                f"method {self.name!r} returned {len(found)} values",
                remedy="return the disparity, or a tuple of it and its standard uncertainty",
            )
        disparity, uncertainty = (self._map(values, left) for values in found)
        return disparity, uncertainty

    def _map(self, values: Any, left: NDArray[Any]) -> NDArray[np.float32]:
        of_pixels = np.ma.filled(np.ma.asarray(values, dtype=np.float32), np.nan)
        if of_pixels.shape != left.shape[:2]:
            raise InputError(
                f"method {self.name!r} returned shape {of_pixels.shape} for images of "
                f"{left.shape[:2]}",
                remedy="return the disparity of each pixel of the left image, [h, w]",
            )
        return of_pixels

    def scaling(self, left: Any, right: Any) -> None:
        """None: nothing is known of what the function does."""


def _function_method(
    name: str,
    function: str,
    margin_px: int = MARGIN_PX,
    options: Mapping[str, Any] | None = None,
) -> Matcher:
    found = _find(function)
    options = dict(options or {})
    if isinstance(found, type):
        found = found(**options)
    elif options:
        found = partial(found, **options)
    return found if isinstance(found, Matcher) else FunctionMethod(found, margin_px, name)


def _find(function: str) -> Any:
    """The function or class that an entry names."""
    place, attribute = place_of(function)
    try:
        if place.endswith(".py"):
            spec = importlib.util.spec_from_file_location(Path(place).stem, place)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
        else:
            if (here := str(Path.cwd())) not in sys.path:
                sys.path.append(here)
            module = importlib.import_module(place)
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise InputError(
            f"cannot import {place}: {error}",
            remedy="install it, or call the workflow from the folder that it lies in",
        ) from error
    try:
        return attrgetter(attribute)(module)
    except AttributeError:
        raise InputError(
            f"module {place} has no {attribute!r}", remedy="name a function of the module"
        ) from None


def make(name: str, kind: str, settings: Mapping[str, Any], workers: int) -> Matcher:
    """The method of a configuration entry.

    ``workers`` threads are told to a program; a function is left to itself.
    """
    if kind == "command":
        return called(name, CommandMethod, {**settings, "name": name, "workers": workers})
    return called(name, _function_method, {**settings, "name": name})
