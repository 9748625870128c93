"""How numerics are compiled: what Python calls, and what only kernels call."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from stereotruth.kernels import inlined, inner, kernel

HOUSE = Path(__file__).parents[2] / "src" / "stereotruth"


@inner
def shifted(values, n, by):
    return values[n] + by


@inlined
def halved(value):
    return value / 2.0


@kernel
def summed(values, out):
    out[0] = shifted(values, 0, 1.0) + shifted(values, 1, 2.0)
    out[1] = halved(out[0]) / 0.0


def test_what_kernels_call_is_plain_python_elsewhere() -> None:
    values, out = np.array([1.5, 2.0]), np.zeros(2)
    summed(values, out)
    by_hand = shifted(values, 0, 1.0) + shifted(values, 1, 2.0)
    assert out.tolist() == [by_hand, np.inf]  # no error where it divides by zero
    assert not hasattr(shifted, "signatures")


def test_all_kernels_take_their_options_from_here() -> None:
    """Else an option would have to be stated a hundred times."""
    importing = re.compile(r"^\s*(from|import) numba\b", re.MULTILINE)
    files = {file for file in HOUSE.rglob("*.py") if importing.search(file.read_text("utf-8"))}
    assert {str(file.relative_to(HOUSE)) for file in files} == {
        "kernel_cache.py",
        "kernels.py",
    }
