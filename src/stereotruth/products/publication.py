"""From reading to publishing: products appear only while what they were made of still stands.

A job of the workflow says what it reads and what it makes (:func:`publication`). Each product
takes its place (:func:`publishing`) only if the job's run is still the newest and its inputs are
what they were when the job began. When all have, a record of the inputs' checksums is kept, and
each later run holds it against the files (:func:`made_of`). A product without any record was made
by hand.
"""

from __future__ import annotations

import logging
import os
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from ..errors import InputError
from .inputs import Checksums, Inputs, Marks, marks, refuse_replaced
from .provenance import digest
from .records import changed_inputs, read_record, write_record
from .runs import KEPT, RUN, Run, listed

log = logging.getLogger("stereotruth")


class _Job:
    def __init__(self, inputs: Iterable[str], outputs: Iterable[str], made: str) -> None:
        self.outputs = {str(Path(path).absolute()): path for path in outputs}
        self.first = next(iter(self.outputs.values()))
        self.made = made
        self.run = Run()
        self.published: dict[str, Marks] = {}
        with self.run.standing():
            write_record(self.first, {"made": made, "run": self.run.name})
        inputs = list(map(str, inputs))
        self.marks = marks(inputs)
        self.inputs = Inputs(inputs, Checksums(KEPT / "checksums"))

    @contextmanager
    def standing(self) -> Iterator[None]:
        with self.run.standing():
            self.inputs.refuse_changed()
            yield

    def end(self) -> None:
        missing = sorted(set(self.outputs) - set(self.published))
        if missing:
            raise RuntimeError(f"written past products.publication: {missing}")
        with self.standing():
            for found in self.published.values():
                refuse_replaced(found)
            record = {
                "made": self.made,
                "run": self.run.name,
                "outputs": list(map(str, self.outputs.values())),
                "inputs": dict(self.inputs.checksums),
            }
            write_record(self.first, record)


_job: _Job | None = None  # what this process makes


@contextmanager
def publication(inputs: Iterable[str], outputs: Iterable[str], made: str) -> Iterator[None]:
    """Make the files and folders ``outputs`` of ``inputs``; ``made``: see :func:`made_of`.

    Raises InputError if an input changes meanwhile, or another run begins.
    """
    global _job
    inputs = list(map(str, inputs))
    with listed():
        job = _Job(inputs, outputs, made)
        _job = job
        try:
            with job.run.watched():
                yield
                job.end()
        except (InputError, OSError):
            raise
        except Exception as error:
            from .damaged_chunks import damage_behind  # few jobs fail, and not all need Zarr

            if damage := damage_behind(error, inputs):
                raise damage from error
            raise
        finally:
            _job = None


@contextmanager
def publishing(path: str | Path) -> Iterator[None]:
    """In the block, and at once, a file or folder takes its place."""
    place = str(Path(path).absolute())
    if _job is None or place not in _job.outputs:
        yield
        return
    placed = False
    try:
        with _job.standing():
            yield
            placed = True
            _job.published[place] = marks([path])
    except InputError:
        if placed:  # locks do nothing here, and another run has begun in this moment
            write_record(_job.first, {"made": f"by an older run: {uuid.uuid4().hex}"})
        raise


def marks_of_inputs() -> Marks:
    """What tells cheaply whether the inputs of this process's job were replaced since it began."""
    return {} if _job is None else _job.marks


@cache
def made_of(product: str) -> str:
    """What the making of a product is called, as a parameter of its rule.

    The same as when it was made, while its inputs have the checksums that were recorded: an
    input that changed unseen by Snakemake gives another, and so makes the product again. So does
    a product of a job that did not end, unless this is its own run, which tries again.
    """
    record = read_record(product)
    if record and Path(product).exists():
        if "inputs" not in record:
            mine = record.get("run") == os.environ.get(RUN, "")
            return record["made"] if mine else digest({"not ended": record})
        if other := changed_inputs(record):
            log.warning("%s is made again: %s changed", product, ", ".join(sorted(other)))
            return digest({"before": record["made"], "inputs": other})
    return record.get("made", "")
