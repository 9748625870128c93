"""Products appear only when they are whole, and while what they were made of still stands.

A job of the workflow says what it reads and what it makes (:func:`atomic_outputs`). Each product
takes its place (:func:`atomically`) only if the job's run is still the newest and its inputs are
what they were when the job began. When all have, the job's record is kept (:mod:`.records`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import InputError
from .inputs import Checksums, Inputs, Marks, marks, refuse_replaced
from .records import (
    DamagedRecord,
    Record,
    contents_of,
    names_of,
    plain,
    read_record,
    write_record,
)
from .runs import KEPT, Run


class _Job:
    def __init__(
        self, inputs: Iterable[str], outputs: Iterable[str], settings: Mapping[str, Any]
    ) -> None:
        self.outputs = {str(Path(path).absolute()): path for path in outputs}
        self.settings = plain(settings)
        self.run = Run()
        self.in_place: dict[str, Marks] = {}
        self.run.refuse_older()
        inputs = contents_of(inputs)
        self.marks = marks(inputs)
        self.inputs = Inputs(inputs, Checksums(KEPT / "checksums"))
        for path, found in self.inputs.checksums.items():
            _refuse_damaged(path, found)

    def refuse_late(self) -> None:
        self.run.refuse_older()
        self.inputs.refuse_changed()

    def end(self) -> None:
        missing = sorted(set(self.outputs) - set(self.in_place))
        if missing:
            raise RuntimeError(f"written past products.atomic_outputs: {missing}")
        made = names_of(self.outputs.values())
        record = Record.of(self.run.name, self.settings, self.inputs.checksums, made)
        self.refuse_late()
        for found in self.in_place.values():
            refuse_replaced(found)
        write_record(record)


def _refuse_damaged(path: str, found: str) -> None:
    """Raise InputError if a job has made an input, and has made something else of that name."""
    try:
        record = read_record(path)
    except DamagedRecord:  # the next plan has the job that it is of
        return
    if record and record.outputs.get(path, found) != found:
        raise InputError(
            "not what was made",
            file=record.damage(path),
            remedy="run again, which makes it again first",
        )


_job: _Job | None = None  # what this process makes


@contextmanager
def atomic_outputs(
    inputs: Iterable[str], outputs: Iterable[str], settings: Mapping[str, Any]
) -> Iterator[None]:
    """Make the files and folders ``outputs`` of ``inputs`` and ``settings``.

    Raises InputError if an input is not what was made of it, or changes meanwhile, or another run
    begins.
    """
    global _job
    inputs = list(map(str, inputs))
    job = _job = _Job(inputs, outputs, settings)
    try:
        with job.run.watched():
            yield
            job.end()
    except (InputError, OSError):
        raise
    except Exception as error:
        from .damaged_store import damaged_store  # few jobs fail, and not all need Zarr

        if damage := damaged_store(error, inputs):
            raise damage from error
        raise
    finally:
        _job = None


@contextmanager
def atomically(path: str | Path) -> Iterator[None]:
    """In the block, and at once, a file or folder takes its place."""
    place = str(Path(path).absolute())
    ours = _job is not None and place in _job.outputs
    if ours:
        _job.refuse_late()
    yield
    if ours:
        _job.in_place[place] = marks([path])


def marks_of_inputs() -> Marks:
    """What tells cheaply whether the inputs of this process's job were replaced since it began."""
    return {} if _job is None else _job.marks
