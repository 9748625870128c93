"""What the pipeline makes of damaged files, each read by a process with a bound on memory and time.

    python -m tests.synthetic.damage_rounds --mutants 10000 --seed 1 [--lidar FOLDER …]

prints the table of docs/damaged_input.md; ``--log`` keeps a line for every mutant. Every mutant is
made by the number of its round alone, so that ``--only LAZ:1234`` does one again.

    python -m tests.synthetic.damage_rounds --products scratch/folder --mutants 120

does so with sheets, control points and what a run has made, so many mutants of each kind; the small
city is made in the folder, if it is not there.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stereotruth.align.align import align, write_alignment
from stereotruth.align.figures import draw_residuals
from stereotruth.align.images import open_view
from stereotruth.core.errors import InputError
from stereotruth.core.job import in_own_process
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.sensor.image_reader import Source

from . import damage
from .damaged_cases import Case, synthetic_cases
from .damaged_products import READERS as PRODUCTS
from .damaged_products import cannot_be_told, product_cases, read_product
from .project import make_tiny

MEMORY = 2 << 30  # bytes beyond what the process has before it meets a damaged file
SECONDS = 30.0
# What may come of a mutant; the first four are as they should be, the last five are not.
FINE = ("refused", "right", "remarked", "cannot be told")
REST = ("other values", "other file named", "traceback", "abort", "hang")


@dataclass(frozen=True)
class Outcome:
    """What came of one mutant."""

    format: str
    case: str
    round: int
    what: str
    came: str
    says: str = ""
    seconds: float = 0.0
    mib: int = 0


# ------------------------------------------------------------------ in the worker: one file read


def _digest(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def _read_lidar(case: Case, file: Path, folder: Path) -> tuple[Any, list[str]]:
    store = folder / "store.points"
    shutil.rmtree(store, ignore_errors=True)
    summary = apart(lambda: ingest(file, store, **case.options), file)
    points = PointStore(store)
    found = points.query(*points.bounds[:4])
    value = _digest(found.lon_q, found.lat_q, found.h_q, found.classification, found.return_number)
    return value, summary["notes"]


def _read_image(case: Case, file: Path, folder: Path) -> tuple[Any, list[str]]:
    sensor, size = open_view("left", file, "")
    with Source(file) as source:
        source.check_blocks()  # as rectify does
        pixels = np.concatenate(
            [source.read(0, row, size[0], min(64, size[1] - row)) for row in range(0, size[1], 64)]
        )
    return [_digest(pixels), str(pixels.shape), _digest(sensor.packed())], []


def _aligned(images: tuple[Path, Path], gcps: Path, folder: Path) -> tuple[Any, list[str]]:
    """Where the corrected RPCs take fixed places on the ground, px."""
    found = align(*images, gcps, scene="damaged", provenance={})
    ids = {g.id for fit in found.fits for g in fit.gcps}
    if any(not name.isascii() or not name.isalnum() or len(name) > 8 for name in ids):
        write_alignment(found, folder / "alignment.json", folder / "alignment.csv")
        draw_residuals(found, folder / "alignment.png")
    lon, lat = np.meshgrid(
        np.linspace(-0.01, 0.01, 5) + 115.4, np.linspace(-0.006, 0.006, 5) + 30.2
    )
    places = [np.stack(sensor.project(lon, lat, 60.0)) for sensor in (found.left, found.right)]
    return np.round(np.array(places), 2).tolist(), list(found.warnings)


def _read_gcps(case: Case, file: Path, folder: Path) -> tuple[Any, list[str]]:
    return _aligned((case.file.parent / "left.tif", case.file.parent / "right.tif"), file, folder)


def _read_rpc(case: Case, file: Path, folder: Path) -> tuple[Any, list[str]]:
    image = file.parent / "left.tif"
    if not image.exists():
        image.symlink_to(case.file.parent / "left.tif")
    gcps = case.file.parent / "gcps.csv"
    return _aligned((image, case.file.parent / "right.tif"), gcps, folder)


def _misbehave(case: Case, file: Path, folder: Path) -> tuple[Any, list[str]]:
    """Does to the process what damaged files must not, to see that it is noticed."""
    kind = case.reader.removeprefix("misbehave: ")
    if file == case.file or kind == "other values":
        return str(file), []
    if kind == "abort":
        os.abort()
    if kind == "hang":
        time.sleep(1000)
    if kind == "memory":
        np.ones(MEMORY)
    raise BaseException(kind)


def _here(work: Callable[[], Any], file: Path) -> Any:
    return work()


# How ingest is called: the rule does so in a process of its own. Here only mutants are that end
# the worker, for the sake of time.
apart: Callable[[Callable[[], Any], Path], Any] = _here
READERS = {"lidar": _read_lidar, "image": _read_image, "gcps": _read_gcps, "rpc": _read_rpc}


class Reader:
    """Reads mutants of good files, and compares with what the good ones give."""

    def __init__(self, cases: Iterable[Case], folder: Path) -> None:
        self.folder = folder
        self.cases = {case.name: case for case in cases}
        self.good = {name: self._read(case, case.file) for name, case in self.cases.items()}
        limit = _kib("VmSize:") * 1024 + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def _read(self, case: Case, file: Path) -> tuple[Any, list[str]]:
        if case.reader in PRODUCTS:
            return read_product(case, file, self.folder)
        return READERS.get(case.reader, _misbehave)(case, file, self.folder)

    def outcome(self, name: str, number: int) -> Outcome:
        case = self.cases[name]
        ways = damage.TEXT if case.text else damage.BYTES
        data, what = damage.damaged(case.file.read_bytes(), number, ways)
        folder = self.folder / "mutant"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        file = folder / case.file.name
        file.write_bytes(data)
        Path("/proc/self/clear_refs").write_text("5")
        before, begun, says = _kib("VmRSS:"), time.monotonic(), ""
        try:
            value, remarks = self._read(case, file)
        except InputError as error:
            says = str(error)
            place = Path(case.options.get("place", file.name))
            named = file.name in says or (place.parent.suffix and place.parent.name in says)
            came = "refused" if named and "Remedy" in says else "other file named"
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            came, says = "traceback", "".join(traceback.format_exception(error)[-4:])
        else:
            good, usual = self.good[name]
            new = [text for text in remarks if text not in usual]
            came, says = "right" if value == good else "remarked", "; ".join(new)
            if came == "remarked" and not new:
                if case.reader in PRODUCTS:
                    hidden = cannot_be_told(case, data)
                else:
                    hidden = case.reader in READERS and case.cannot_be_told(data, value, good)
                came = "cannot be told" if hidden else "other values"
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss  # the most so far
        most = max(_kib("VmHWM:"), children) - before
        seconds, mib = time.monotonic() - begun, max(0, most) // 1024
        return Outcome(case.format, name, number, what, came, says[:600], round(seconds, 2), mib)


def _kib(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1])
    return 0


def _work(cases_file: str, folder: str) -> None:
    global apart
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    cases = [Case.from_dict(case) for case in json.loads(Path(cases_file).read_text())]
    reader = Reader(cases, Path(folder))
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        name, number, once_more = json.loads(line)
        apart = in_own_process if once_more else _here
        print(json.dumps(asdict(reader.outcome(name, number))), file=answers, flush=True)


# ------------------------------------------------------------------ outside: many files


class Worker:
    """A process that reads mutants; started again after each that it does not outlive."""

    def __init__(self, cases: list[Case], folder: Path) -> None:
        self.cases = {case.name: case for case in cases}
        self.folder = Path(tempfile.mkdtemp(dir=folder))
        self.list = self.folder / "cases.json"
        self.list.write_text(json.dumps([case.to_dict() for case in cases]))
        self.process: subprocess.Popen | None = None

    def _start(self) -> None:
        command = [sys.executable, "-m", __spec__.name, "--worker", self.list, self.folder]
        with (self.folder / "stderr").open("w") as errors:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
            )
        if self._answer(300.0) != "ready":
            raise RuntimeError((self.folder / "stderr").read_text()[-2000:])

    def _answer(self, seconds: float) -> str | None:
        """The next line; None: it took too long; empty: the process has ended."""
        if not select.select([self.process.stdout], [], [], seconds)[0]:
            return None
        return self.process.stdout.readline().strip()

    def outcome(self, name: str, number: int, once_more: bool = False) -> Outcome:
        """What comes of one mutant, whatever it does to the process."""
        if self.process is None:
            self._start()
        self.process.stdin.write(json.dumps([name, number, once_more]) + "\n")
        self.process.stdin.flush()
        answer = self._answer(SECONDS)
        if answer:
            return Outcome(**json.loads(answer))
        case = self.cases[name]
        ways = damage.TEXT if case.text else damage.BYTES
        what = damage.damaged(case.file.read_bytes(), number, ways)[1]
        if answer is None:
            came, says = "hang", f"killed after {SECONDS:g} s"
        else:
            self.process.wait()
            came, says = "abort", (self.folder / "stderr").read_text()[-600:]
        self.close()
        if came == "abort" and not once_more and case.reader == "lidar":
            return self.outcome(name, number, once_more=True)
        seconds = SECONDS if came == "hang" else 0.0
        return Outcome(case.format, name, number, what, came, says, seconds)

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process.stdin.close()
            self.process.stdout.close()
        self.process = None


def rounds(cases: list[Case], mutants: int, seed: int, folder: Path) -> Iterator[Outcome]:
    """Outcomes of so many mutants in all, the cases by turns."""
    worker = Worker(cases, folder)
    try:
        for k in range(mutants):
            yield worker.outcome(cases[k % len(cases)].name, seed * 1_000_000 + k)
    finally:
        worker.close()


def table(outcomes: list[Outcome]) -> str:
    """Markdown: how many mutants of each format came to what."""
    kinds = (*FINE, *REST)
    head = "| format | tried | " + " | ".join(kinds) + " | longest, s | most, MiB |"
    lines = [head, "|" + "---|" * (len(kinds) + 4)]
    for name in [*dict.fromkeys(o.format for o in outcomes), "all"]:
        of = [o for o in outcomes if name in (o.format, "all")]
        count = Counter(o.came for o in of)
        cells = [name, len(of), *(count[kind] for kind in kinds)]
        cells += [f"{max(o.seconds for o in of):.1f}", max(o.mib for o in of)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["--worker"]:
        return _work(*arguments[1:])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lidar", type=Path, nargs="*", default=[], help="more good files")
    parser.add_argument("--images", type=Path, nargs="*", default=[], help="with RPCs")
    parser.add_argument("--cases", default="", help="part of the names of those to take")
    parser.add_argument("--only", default="", help="case:round, done once in this process")
    parser.add_argument("--log", type=Path)
    parser.add_argument("--products", type=Path, help="folder for the city that a run makes")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as stack:
        folder = Path(scratch)
        cases = synthetic_cases(folder / "good", given.lidar, given.images)
        if given.products:
            gcps = [
                replace(case, format="control points") for case in cases if case.format == "GCP CSV"
            ]
            cases = [*product_cases(make_tiny(given.products.absolute()).folder), gcps[0]]
        cases = [case for case in cases if given.cases in case.name]
        if given.only:
            name, _, number = given.only.rpartition(":")
            reader = Reader([case for case in cases if case.name == name], folder)
            print(json.dumps(asdict(reader.outcome(name, int(number))), indent=1))
            return None
        log = stack.enter_context(given.log.open("w")) if given.log else None
        outcomes = []
        kinds = sorted({case.format for case in cases}) if given.products else [None]
        for kind in kinds:
            some = [case for case in cases if kind in (None, case.format)]
            for outcome in rounds(some, given.mutants, given.seed, folder):
                outcomes.append(outcome)
                if log:
                    print(json.dumps(asdict(outcome)), file=log, flush=True)
        print(table(outcomes))
    return None


if __name__ == "__main__":
    main(sys.argv[1:])
