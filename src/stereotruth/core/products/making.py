"""A job of the workflow: the only one that makes its products, of inputs that stay as they are."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import InputError
from . import remote_files
from .inputs import Marks, marks, refuse_replaced
from .locks import exclusive
from .provenance import digest

MADE = Path(".snakemake", "stereotruth", "made")  # what the jobs of a run have made
_inputs: Marks = {}  # of this process's job


@contextmanager
def making(inputs: Iterable[str | Path], outputs: Sequence[str | Path]) -> Iterator[None]:
    """Make files and folders ``outputs`` of ``inputs``, as the only process that does.

    A job of a run that was killed may still be at work on them: this one waits until it has ended,
    so that what it makes is there last. Raises InputError if an input was written or replaced
    meanwhile, if only for a while; the products are then dropped by Snakemake.
    """
    global _inputs
    inputs = [str(path) for path in inputs]
    with exclusive(outputs[0]):
        _inputs = marks(inputs)
        try:
            yield
            refuse_replaced(_inputs)
            for path in inputs:
                remote_files.refuse_changed(path)
            _note(outputs)
        except (InputError, OSError):
            raise
        except Exception as error:
            from .damaged_store import damaged_store  # few jobs fail, and not all need Zarr

            if damage := damaged_store(error, inputs):
                raise damage from error
            raise
        finally:
            _inputs = {}


def begin_notes() -> None:
    """Have the jobs of a run that begins note what they make."""
    shutil.rmtree(MADE, ignore_errors=True)
    MADE.mkdir(parents=True, exist_ok=True)


def noted() -> list[str]:
    """Files and folders that the jobs of the newest run have made."""
    return [path for file in sorted(MADE.glob("*")) for path in json.loads(file.read_text())]


def _note(outputs: Sequence[str | Path]) -> None:
    """One file for each job: several nodes may write at once."""
    names = [str(path) for path in outputs]
    with suppress(FileNotFoundError):  # no run of the workflow
        (MADE / digest(names)).write_text(json.dumps(names))


def marks_of_inputs() -> Marks:
    """What tells cheaply whether the inputs of this process's job were replaced since it began."""
    return _inputs
