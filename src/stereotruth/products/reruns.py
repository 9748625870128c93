"""Reruns by content alone: what Snakemake needs to see that products are what they should be.

Snakemake judges by times: a product that is older than one of its inputs is out of date, unless
the input is a file with the checksum that Snakemake has recorded. Copies and restored files have
any times, and for folders it compares nothing else. So each run begins by giving products that are
older than their inputs, although these are what they were, the times of the inputs
(:func:`settle_times`), and Snakemake's own records lie in ``results``, beside ours
(:func:`keep_metadata`).
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from .inputs import NOT_CONTENT
from .records import RECORDS, all_records, changed_inputs
from .runs import KEPT

METADATA = Path(".snakemake", "metadata")  # where Snakemake looks for its own records
PLACE = RECORDS / "snakemake"  # where they lie
SAVED = KEPT / "metadata"


def _dated(path: str) -> Path:
    """The file whose time Snakemake takes for that of a file or folder."""
    inside = Path(path, NOT_CONTENT)
    return inside if inside.exists() else Path(path)


def _time(path: str) -> int:
    """As Snakemake takes it, ns: a link is as new as itself and what it links to."""
    then = _dated(path).stat().st_mtime_ns
    return max(then, Path(path).lstat().st_mtime_ns) if Path(path).is_symlink() else then


def settle_times(logs: Path = Path("logs")) -> None:
    """Make no product older than its inputs if these are what they were when it was made.

    ``logs``: folder of the jobs' measurements (TSV), which count as products, too.
    """
    made = {path: record for record in all_records() for path in record["outputs"]}
    times: dict[str, int] = {}

    def settle(path: str) -> int:
        """Time of a file or folder, ns, after it has been settled; 0 if it is missing."""
        if path in times:
            return times[path]
        try:
            then = _time(path)
        except FileNotFoundError:
            then = 0
        times[path] = then
        record = made.get(path)
        if record and then:
            wanted = max(map(settle, record["inputs"]), default=0)
            if wanted > then and not changed_inputs(record):
                _date(_dated(path), wanted)
                times[path] = wanted
        return times[path]

    newest = max(map(settle, made), default=0)
    for file in logs.rglob("*.tsv"):
        if file.stat().st_mtime_ns < newest:
            _date(file, newest)


def _date(file: Path, time_ns: int) -> None:
    with suppress(OSError):  # somebody else's: Snakemake then judges by the times that there are
        os.utime(file, ns=(time_ns, time_ns))


def keep_metadata(*, begin: bool) -> None:
    """Have Snakemake keep its own records in ``results``; ``begin``: also if it has none yet.

    If the results were deleted, what was saved of the records goes back to where Snakemake looks:
    other products are still there. Where the file system knows no links, all stays there.
    """
    if begin:
        PLACE.mkdir(parents=True, exist_ok=True)
    if not PLACE.is_dir():
        if METADATA.is_symlink():
            METADATA.unlink()
            if SAVED.is_dir():
                shutil.copytree(SAVED, METADATA)
        return
    if METADATA.is_symlink():
        return
    METADATA.with_name("incomplete").mkdir(parents=True, exist_ok=True)  # else they are "migrated"
    link = METADATA.with_name("metadata.link")
    try:
        link.unlink(missing_ok=True)
        link.symlink_to(os.path.relpath(PLACE, METADATA.parent))
    except OSError:
        return
    _copy_missing(METADATA, PLACE)
    shutil.rmtree(METADATA, ignore_errors=True)
    link.rename(METADATA)


def save_metadata() -> None:
    """Keep a copy of Snakemake's records, for when the results are deleted."""
    if METADATA.is_symlink() and PLACE.is_dir():
        shutil.rmtree(SAVED, ignore_errors=True)
        with suppress(OSError):  # a full disk
            shutil.copytree(PLACE, SAVED)


def _copy_missing(source: Path, target: Path) -> None:
    for file in source.rglob("*"):
        other = target / file.relative_to(source)
        if file.is_file() and not other.exists():
            other.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, other)
