"""Records of jobs: what their products were made of, and what is due because that no longer holds.

Before a job starts, a mark is laid (:func:`mark_begun`). The job's record takes it away, when all
of its products are in their places: settings and digests of code, checksums of inputs and of
products. Record and mark are all that a plan goes by (:func:`why_due`). Times of files count for
nothing. Records lie in ``results``, and travel with it; copies of them lie beside Snakemake's own,
for products that outlive ``results``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from .inputs import Checksums, combined, file_checksums
from .provenance import digest
from .runs import KEPT

PLACES = (Path("results", ".records", "made"), KEPT / "made")
BEGUN = ".begun"  # suffix of the mark of a job that has not ended
DIGESTS = ("code", "script", "measuring", "templates")  # settings whose values say nothing


@dataclass(frozen=True)
class Record:
    """What a job has made of what.

    ``run``: see :mod:`.runs`; ``settings``: parameters and digests of code, JSON-ready; ``inputs``
    and ``outputs``: SHA-256 by name (:func:`names_of`); ``files``: of folders among the outputs,
    the beginnings of the SHA-256 of their files, by which a damaged one is named.
    """

    run: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    files: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @classmethod
    def of(cls, run: str, settings: Mapping, inputs: Mapping, outputs: Iterable[str]) -> Record:
        """The record of outputs as they are now."""
        sums = {path: file_checksums(path) for path in outputs}
        files = {path: _short(of) for path, of in sums.items() if Path(path).is_dir()}
        made = {path: combined(of) for path, of in sums.items()}
        return cls(run, settings, dict(inputs), made, files)

    def damage(self, path: str) -> str:
        """Which files of an output are not what was made, in words; the output, if it is a file."""
        was = self.files.get(path)
        if was is None or not Path(path).is_dir():
            return path
        now = _short(file_checksums(path))
        names = sorted(name for name in {*was, *now} if was.get(name) != now.get(name))
        said = [f"{path}/{name}{'' if name in now else ' (missing)'}" for name in names]
        more = f" and {len(said) - 3} more files" if len(said) > 3 else ""
        return (", ".join(said[:3]) or path) + more


def _short(sums: Mapping[str, str]) -> dict[str, str]:
    return {name: value[:12] for name, value in sums.items()}


class DamagedRecord(Exception):
    """A record is not what was written. Its text names the file."""


def names_of(paths: Iterable[str | Path]) -> list[str]:
    """Paths as records have them: relative to the working directory, if they lie in it."""
    here = Path.cwd()
    found = [Path(path) for path in paths]
    return [str(p.relative_to(here) if p.is_relative_to(here) else p) for p in found]


def contents_of(inputs: Iterable[str | Path]) -> list[str]:
    """Names of the inputs without those that only tell that a strip of a grid is made."""
    return [name for name in names_of(inputs) if Path(name).parent.name != "strips"]


def record_file(product: str | Path, place: Path = PLACES[0]) -> Path:
    """Where the record of a product lies."""
    return place / f"{os.path.relpath(product).replace(os.pardir, '_')}.json"


def write_record(record: Record) -> None:
    """Keep the record of a job that has ended, under the name of each of its products."""
    content = asdict(record)
    text = json.dumps({"digest": digest(content), "record": content})
    for place in PLACES:
        for product in record.outputs:
            file = record_file(product, place)
            file.parent.mkdir(parents=True, exist_ok=True)
            scratch = file.with_name(f".{file.name}.{os.getpid()}")
            scratch.write_text(text)
            scratch.replace(file)
    _mark(next(iter(record.outputs))).unlink(missing_ok=True)


def read_record(product: str | Path) -> Record | None:
    """The record of a product; None if there is none. Raises DamagedRecord."""
    for place in PLACES:
        file = record_file(product, place)
        try:
            found = json.loads(file.read_bytes())
            if found["digest"] == digest(found["record"]):
                return Record(**found["record"])
        except FileNotFoundError:
            continue
        except (ValueError, TypeError, KeyError, RecursionError, OSError):
            pass
        raise DamagedRecord(str(file))
    return None


def all_records() -> Iterator[Record]:
    """The records of all jobs that have ended well; damaged ones are passed over."""
    for file in sorted(PLACES[0].rglob("*.json")):
        name = str(file.relative_to(PLACES[0]).with_suffix(""))
        try:
            record = read_record(name)
        except DamagedRecord:
            continue
        if record and next(iter(record.outputs)) == name:
            yield record


def _mark(product: str | Path) -> Path:
    file = record_file(product)
    return file.with_name(file.name + BEGUN)


def mark_begun(product: str | Path) -> None:
    """Note that a job is to make its products, of which this is the first."""
    mark = _mark(product)
    with suppress(OSError):  # a full disk: what changed is seen nevertheless
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()


def plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as records have them."""
    return json.loads(json.dumps(dict(settings.items()), default=str, sort_keys=True))


@cache
def _checksums() -> Checksums:
    return Checksums(KEPT / "checksums")


@cache
def _checksum(path: str) -> str:
    """Checksum of what is there; of what is not, the recorded one; empty if there is none."""
    if Path(path).exists():
        return _checksums().of(path)[1]
    try:
        record = read_record(path)
    except DamagedRecord:
        return ""
    return record.outputs.get(path, "") if record else ""


def why_due(
    outputs: Sequence[str | Path], inputs: Sequence[str | Path], settings: Mapping[str, Any]
) -> str:
    """Why a job is to run (again), in a few words; empty if it is not.

    Looks at this job alone: that products are absent which somebody needs, and that a job before
    it is due, is for the plan to see. A product that is absent is held to its record, so that the
    chain behind a product counts whether its links are there or not.
    """
    outputs, inputs = names_of(outputs), contents_of(inputs)
    if _mark(outputs[0]).exists():
        return "the job that makes it did not end"
    try:
        record = read_record(outputs[0])
    except DamagedRecord as error:
        return f"damaged record {error}"
    if record is None:
        return _older(outputs, inputs)
    for path in filter(os.path.lexists, outputs):
        if _checksum(path) != record.outputs.get(path):
            return f"{record.damage(path)} is not what was made: made again"
    if other := set(inputs) ^ set(record.inputs):
        return f"other input: {', '.join(sorted(other))}"
    if changed := [p for p in inputs if _checksum(p) not in ("", record.inputs[p])]:
        return f"{', '.join(changed)} changed"
    return _changes(record.settings, plain(settings))


def _older(outputs: Sequence[str], inputs: Sequence[str]) -> str:
    """Without a record, as where products were laid by hand, times are all that there is."""
    times = [Path(path).stat().st_mtime_ns for path in outputs if Path(path).exists()]
    for path in filter(os.path.exists, inputs if times else ()):
        if Path(path).stat().st_mtime_ns > min(times):
            return f"no record, and older than {path}"
    return ""


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Which settings changed, with their values where these are short and mean something."""
    old, new, said = dict(_flat(before)), dict(_flat(now)), []
    for key in sorted(key for key in {*old, *new} if old.get(key) != new.get(key)):
        values = f" {old.get(key)!r} -> {new.get(key)!r}"
        said.append(key if key.split(".")[0] in DIGESTS or len(values) > 80 else key + values)
    return f"changed: {', '.join(said)}" if said else ""


def _flat(settings: Mapping[str, Any], of: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{of}{key}.")
        else:
            yield f"{of}{key}", value
