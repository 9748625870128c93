"""A job of the workflow: the only one that makes its products, of inputs that stay as they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError
from . import remote_files
from .inputs import Marks, marks, refuse_replaced
from .locks import exclusive

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
        except (InputError, OSError):
            raise
        except Exception as error:
            from .damaged_store import damaged_store  # few jobs fail, and not all need Zarr

            if damage := damaged_store(error, inputs):
                raise damage from error
            raise
        finally:
            _inputs = {}


def marks_of_inputs() -> Marks:
    """What tells cheaply whether the inputs of this process's job were replaced since it began."""
    return _inputs
