"""A program of the user's, with an environment or container of its own, as a stereo method.

``command`` of an entry is split into words as a shell does, but no shell runs it. In each word,
``{left}`` and ``{right}`` are files of the images (TIFF of the images' own type), ``{out}`` the
file that the disparities x_left − x_right go to ([h, w] px, NaN, infinity or a tagged nodata where
there is none; ``suffix``: TIFF, NumPy's .npy or .pfm), ``{low}`` and ``{high}`` the range (the
second excluded), ``{threads}`` the threads that it may use.

With ``uncertainty: true`` it also writes the standard uncertainty of each disparity in px to
``{uncertainty}``, a map as the other one; with ``pairs: file`` that is the fourth of a row.

``pairs: each``: the program is called for each pair. ``pairs: file``: it is called once for up to
``MOST_PAIRS`` pairs, and ``{pairs}`` is a CSV file without header, a row ``left,right,out`` for
each. A result is taken as soon as that of a later row has been begun and it was left alone for
``SETTLED_SECONDS``, or the program has ended; so a program that fails keeps what it has done but
for the last, which may be half written.

The seconds of a pair are those of its call, with the start of the program; with ``pairs: file``
they are the time between its result and that of the row before. Memory is that of the program and
of those that it started, looked at every ``POLL_SECONDS``; programs in containers of a daemon
(Docker) are not seen.
"""

from __future__ import annotations

import csv
import re
import shlex
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import psutil
from numpy.typing import NDArray

from stereotruth.core.errors import InputError

from .kinds import words_of
from .matcher import DisparityRange, ImagePair, Matched, UncertainMatcher, called
from .result_files import SUFFIXES, read_result

MARGIN_PX = 128  # of a program that states none
MOST_PAIRS = 256  # of one call: their images lie in the temporary folder
POLL_SECONDS = 0.05
SETTLED_SECONDS = 1.0
TAIL_LINES, TAIL_CHARACTERS = 20, 2000  # of the program's output, in messages
MB = 1 << 20
NEEDED = {"each": ("{left}", "{right}", "{out}"), "file": ("{pairs}",)}


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
                shapes = [pair.left.shape[:2] for pair in some]
                names = [pair.name for pair in some]
                del some
                yield from self._results(Path(folder), names, rows, shapes, disparity_range)

    def _written(self, folder: Path, pair: ImagePair) -> list[Path]:
        """The files of a pair: images, which are written, and results."""
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
        names: Sequence[str],
        rows: Sequence[list[Path]],
        shapes: Sequence[tuple[int, int]],
        disparity_range: DisparityRange,
    ) -> Iterator[Matched]:
        table = folder / "pairs.csv"
        with table.open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerows(rows)
        low, high = disparity_range
        values = dict(zip(self._columns, rows[0]), pairs=table, low=low, high=high)
        values["threads"] = self._workers
        words = [_filled(word, values) for word in self._words]
        outs = [row[2:] for row in rows]
        last, done = time.time(), 0
        with self._started(words, folder / "output.txt") as program:
            while done < len(outs):
                status = program.wait(POLL_SECONDS)
                lacking = [out for out in outs[done] if not out.is_file()]
                if status == 0 and lacking:
                    what = "uncertainty" if lacking[0] not in outs[done][:1] else "disparities"
                    raise program.failure(f"wrote no {what} of pair {names[done]}", names[done])
                if _finished(outs, done, status):
                    written = max(out.stat().st_mtime for out in outs[done])
                    seconds = max(written - last, 0.0) if len(outs) > 1 else program.seconds
                    last = max(written, last)
                    maps = [read_result(out) for out in outs[done]]
                    for found in maps:
                        if found.shape != shapes[done]:
                            raise program.failure(
                                f"wrote disparities of {found.shape} px for images of "
                                f"{shapes[done]}",
                                names[done],
                            )
                    yield Matched(maps[0], seconds, program.memory_mb, *maps[1:])
                    for out in outs[done]:
                        out.unlink()
                    done += 1
                elif status:
                    how = f"status {status}" if status > 0 else f"signal {-status}"
                    begun = [any(out.exists() for out in of) for of in outs]
                    at = next((n for n in range(done, len(outs)) if not begun[n]), -1)
                    raise program.failure(f"ended with {how}", names[at])
            if program.wait():
                raise program.failure("failed after its last result", names[-1])

    @contextmanager
    def _started(self, words: Sequence[str], output: Path) -> Iterator[_Program]:
        try:
            program = _Program(self._name, words, output)
        except OSError as error:
            raise InputError(
                f"method {self._name!r}: cannot start {words[0]}: {error.strerror}",
                remedy="name a program that is there and can be run",
            ) from None
        try:
            yield program
        finally:
            program.kill()


class _Program:
    """A running program, its peak memory and seconds so far."""

    def __init__(self, name: str, words: Sequence[str], output: Path) -> None:
        self._name, self._words, self._output = name, words, output
        self.memory_mb: float | None = None
        self.seconds = 0.0
        self._status: int | None = None
        self._start = time.perf_counter()
        with output.open("wb") as stream:
            self._process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT
            )
        self._watched = psutil.Process(self._process.pid)

    def wait(self, seconds: float | None = None) -> int | None:
        """Its exit status, None while it runs; waits for so long at most (None: to its end)."""
        while self._status is None:
            self._look()
            with suppress(subprocess.TimeoutExpired):
                self._status = self._process.wait(POLL_SECONDS if seconds is None else seconds)
            self.seconds = time.perf_counter() - self._start
            if seconds is not None:
                break
        return self._status

    def _look(self) -> None:
        held = 0
        with suppress(psutil.Error):
            for process in (self._watched, *self._watched.children(recursive=True)):
                with suppress(psutil.Error):
                    held += process.memory_info().rss
        if held:
            self.memory_mb = max(self.memory_mb or 0.0, round(held / MB, 1))

    def kill(self) -> None:
        """End it, and what it started, if it still runs."""
        if self._process.poll() is None:
            with suppress(psutil.Error):
                for process in self._watched.children(recursive=True):
                    with suppress(psutil.Error):
                        process.kill()
            self._process.kill()
            self._process.wait()

    def failure(self, what: str, pair: str) -> InputError:
        """What went wrong at a pair, with the end of the program's output."""
        text = self._output.read_text(encoding="utf-8", errors="replace")
        lines = text[-TAIL_CHARACTERS:].splitlines()[-TAIL_LINES:]
        said = "its output ends with:\n" + "\n".join(lines) if lines else "it said nothing"
        return InputError(
            f"method {self._name!r}, pair {pair}: the program {what}; {said}\n"
            f"It was called by: {shlex.join(self._words)}",
            remedy="mend the program or its command and run again; finished pairs are kept",
        )


def _filled(word: str, values: Mapping[str, Any]) -> str:
    """A word of the command with what its placeholders stand for; a value is not read again."""
    return re.sub(r"\{(\w+)\}", lambda found: str(values.get(found[1], found[0])), word)


def _finished(outs: Sequence[Sequence[Path]], index: int, status: int | None) -> bool:
    """Whether the results of a pair are whole, as far as can be told from outside."""
    there = all(out.is_file() for out in outs[index])
    if not there or status == 0:
        return there
    if not any(out.exists() for later in outs[index + 1 :] for out in later):
        return False
    written = max(out.stat().st_mtime for out in outs[index])
    return status is not None or time.time() - written > SETTLED_SECONDS


def make(name: str, kind: str, settings: Mapping[str, Any], workers: int) -> CommandMethod:
    """The method of a configuration entry; ``workers`` threads are told to the program."""
    return called(name, CommandMethod, {**settings, "name": name, "workers": workers})
