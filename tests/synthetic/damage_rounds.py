"""What the pipeline makes of damaged files, each read by a process with a bound on memory and time.

    python -m tests.synthetic.damage_rounds --mutants 10000 --seed 1 [--lidar FOLDER …]

prints the table of docs/damaged_input.md. Every mutant is made by the number of its round alone.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereotruth.align.align import align, write_alignment
from stereotruth.align.figures import draw_residuals
from stereotruth.align.images import open_view
from stereotruth.core.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.sensor.images import Source

from . import damage
from .damaged_cases import Case, synthetic_cases

MEMORY = 2 << 30  # bytes beyond what the process has before it meets a damaged file
SECONDS = 30.0
# What may come of a mutant; the first four are as they should be, the last five are not.
FINE = ("refused", "right", "remarked", "cannot be told")
REST = ("other values", "other file named", "traceback", "abort", "hang")
FORK = multiprocessing.get_context("fork")
Read = tuple[Any, list[str]]  # what a file holds, and remarks


@dataclass(frozen=True)
class Outcome:
    """What came of one mutant."""

    format: str
    case: str
    round: int
    came: str
    says: str = ""
    seconds: float = 0.0


def _digest(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def _read_lidar(case: Case, file: Path, folder: Path) -> Read:
    store = folder / "store.points"
    shutil.rmtree(store, ignore_errors=True)
    summary = ingest(file, store, **case.options)
    points = PointStore(store)
    found = points.query(*points.bounds[:4])
    value = _digest(found.lon_q, found.lat_q, found.h_q, found.classification, found.return_number)
    return value, summary["notes"]


def _read_image(case: Case, file: Path, folder: Path) -> Read:
    sensor, size = open_view("left", file, "")
    with Source(file) as source:
        source.check_blocks()  # as rectify does
        pixels = np.concatenate(
            [source.read(0, row, size[0], min(64, size[1] - row)) for row in range(0, size[1], 64)]
        )
    return [_digest(pixels), str(pixels.shape), _digest(sensor.packed())], []


def _aligned(images: tuple[Path, Path], gcps: Path, folder: Path) -> Read:
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


def _read_gcps(case: Case, file: Path, folder: Path) -> Read:
    return _aligned((case.file.parent / "left.tif", case.file.parent / "right.tif"), file, folder)


def _read_rpc(case: Case, file: Path, folder: Path) -> Read:
    image = file.parent / "left.tif"
    if not image.exists():
        image.symlink_to(case.file.parent / "left.tif")
    gcps = case.file.parent / "gcps.csv"
    return _aligned((image, case.file.parent / "right.tif"), gcps, folder)


READERS = {"lidar": _read_lidar, "image": _read_image, "gcps": _read_gcps, "rpc": _read_rpc}


def _report(
    case: Case, good: tuple[Any, list[str]], number: int, folder: Path, sending: Any
) -> None:
    """In a fork with a bound on its memory: read a mutant, and send what comes of it."""
    limit = _vm_bytes() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    data = damage.damaged(
        case.file.read_bytes(), number, damage.TEXT if case.text else damage.BYTES
    )
    file = folder / case.file.name
    file.write_bytes(data)
    try:
        value, remarks = READERS[case.reader](case, file, folder)
    except InputError as error:
        named = file.name in str(error) and "Remedy" in str(error)
        sending.send(("refused" if named else "other file named", str(error)))
    except BaseException as error:
        sending.send(("traceback", "".join(traceback.format_exception(error)[-4:])))
    else:
        new = [text for text in remarks if text not in good[1]]
        came = "right" if value == good[0] else "remarked"
        if came == "remarked" and not new:
            hidden = case.cannot_be_told(data, value, good[0])
            came = "cannot be told" if hidden else "other values"
        sending.send((came, "; ".join(new)))


def _vm_bytes() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmSize:"))


def outcome(case: Case, good: Read, number: int, folder: Path) -> Outcome:
    """What comes of one mutant, whatever it does to its process.

    A decoder that crashes is no fault: the rule ingest decodes in a process of its own.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    receiving, sending = FORK.Pipe(duplex=False)
    begun = time.monotonic()
    process = FORK.Process(target=_report, args=(case, good, number, folder, sending))
    process.start()
    sending.close()
    try:
        came, says = receiving.recv() if receiving.poll(SECONDS) else ("hang", "")
    except EOFError:
        came, says = "refused" if case.reader == "lidar" else "abort", "the process has ended"
    process.kill()
    process.join()
    seconds = round(time.monotonic() - begun, 2)
    return Outcome(case.format, case.name, number, came, says[:600], seconds)


def rounds(cases: list[Case], mutants: int, seed: int, folder: Path) -> Iterator[Outcome]:
    """Outcomes of so many mutants in all, the cases by turns."""
    good = {case.name: READERS[case.reader](case, case.file, folder) for case in cases}
    for k in range(mutants):
        case = cases[k % len(cases)]
        yield outcome(case, good[case.name], seed * 1_000_000 + k, folder / "mutant")


def table(outcomes: list[Outcome]) -> str:
    """Markdown: how many mutants of each format came to what."""
    kinds = (*FINE, *REST)
    head = "| format | tried | " + " | ".join(kinds) + " | longest, s |"
    lines = [head, "|" + "---|" * (len(kinds) + 3)]
    for name in [*dict.fromkeys(o.format for o in outcomes), "all"]:
        of = [o for o in outcomes if name in (o.format, "all")]
        count = Counter(o.came for o in of)
        cells = [name, len(of), *(count[kind] for kind in kinds)]
        cells += [f"{max(o.seconds for o in of):.1f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lidar", type=Path, nargs="*", default=[], help="more good files")
    parser.add_argument("--images", type=Path, nargs="*", default=[], help="with RPCs")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        cases = synthetic_cases(Path(scratch) / "good", given.lidar, given.images)
        print(table(list(rounds(cases, given.mutants, given.seed, Path(scratch)))))


if __name__ == "__main__":
    main(sys.argv[1:])
