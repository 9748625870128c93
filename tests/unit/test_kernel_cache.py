"""Compiled kernels on disk: an edit compiles what follows from it again, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from stereotruth import kernel_cache
from stereotruth.kernel_cache import content

KERNELS = """
from typing import NamedTuple
import numpy as np
from stereotruth.kernels import kernel
from parts import LEAST, shifted

class Line(NamedTuple):
    slope: float
    level: float

@kernel
def total(values, line):
    kept = np.zeros(1)
    for value in values:
        kept[0] += max(shifted(value), LEAST) * line.slope
    return kept[0]

def unused(value):
    return value
"""
PARTS = """
from stereotruth.kernels import inlined, inner

LEAST = 0.5
TABLE = (1.0, 2.0)

@inlined
def moved(value):
    return value + TABLE[1]

@inner
def shifted(value):
    return moved(value) + 1.0
"""
MAIN = """
import sys
import numpy as np
from uses import Line, total
print(total(np.array([1.0, 2.0]), Line(2.0, 5.0)), "numba.np.linalg" in sys.modules)
"""
WITHOUT_EFFECT = {
    "a docstring": ("uses", "    kept =", '    """Words."""\n    kept ='),
    "lines above": ("uses", "@kernel", "# One.\n\n\n@kernel"),
    "a neighbour": ("uses", "    return value\n", "    return -value\n"),
    "a docstring of a callee": ("parts", "    return moved", '    "Words."\n    return moved'),
}
WITH_EFFECT = {
    "the kernel": ("uses", "np.zeros(1)", "np.ones(1)"),
    "a function of another file": ("parts", "+ 1.0", "+ 3.0"),
    "a function called by that": ("parts", "value + TABLE", "value - TABLE"),
    "a constant": ("parts", "LEAST = 0.5", "LEAST = 9.5"),
    "a table": ("parts", "(1.0, 2.0)", "(1.0, 4.0)"),
    "how it is compiled": ("parts", "@inlined", "@inner"),
}


def after(edit: tuple[str, str, str] | None = None) -> dict[str, str]:
    """The two files' texts after an edit."""
    texts = {"uses": KERNELS, "parts": PARTS}
    if edit:
        name, old, new = edit
        assert texts[name].count(old) == 1
        texts[name] = texts[name].replace(old, new)
    return texts


@pytest.fixture
def content_after(tmp_path, monkeypatch):
    """The content of the kernel in files that are imported anew."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def measure(edit: tuple[str, str, str] | None = None) -> str:
        for name, text in after(edit).items():
            (tmp_path / f"{name}.py").write_text(text)
            sys.modules.pop(name, None)
        import uses

        return content(uses.total.py_func)

    yield measure
    for name in after():
        sys.modules.pop(name, None)


@pytest.mark.parametrize("edit", WITHOUT_EFFECT)
def test_what_is_not_computed_does_not_count(content_after, edit):
    assert content_after() == content_after(WITHOUT_EFFECT[edit])


@pytest.mark.parametrize("edit", WITH_EFFECT)
def test_what_is_computed_counts(content_after, edit):
    assert content_after() != content_after(WITH_EFFECT[edit])


def test_a_global_that_is_no_constant_is_refused(content_after):
    with pytest.raises(TypeError, match=r"parts\.moved uses .*object.*: no constant"):
        content_after(("parts", "TABLE = (1.0, 2.0)", "TABLE = object()"))


@pytest.mark.slow
def test_an_edit_of_what_a_kernel_calls_compiles_it_and_another_edit_does_not(tmp_path) -> None:
    """A run's job starts sooner without the compiler, whose imports take longer than Numba's."""
    (tmp_path / "main.py").write_text(MAIN)

    def run(edit: tuple[str, str, str] | None = None) -> list[str]:
        for name, text in after(edit).items():
            (tmp_path / f"{name}.py").write_text(text)
        environment = {
            **os.environ,
            "NUMBA_CACHE_DIR": str(tmp_path / "compiled"),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        done = subprocess.run(
            [sys.executable, "main.py"], cwd=tmp_path, env=environment,
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout.split()

    assert run() == ["18.0", "True"]  # ((1 + 3) + (2 + 3)) * 2
    assert run(WITHOUT_EFFECT["lines above"]) == ["18.0", "False"]
    assert run(("parts", "+ 1.0", "+ 3.0")) == ["26.0", "True"]
    swapped = ("uses", "slope: float\n    level: float", "level: float\n    slope: float")
    assert run(swapped) == ["45.0", "True"]  # fields are known by number
    for file in (tmp_path / "compiled").iterdir():
        file.write_bytes(file.read_bytes()[:100])  # as after a crash
    assert run() == ["18.0", "True"]


def test_of_two_processes_one_compiles(tmp_path) -> None:
    for name, text in {**after(), "main": MAIN}.items():
        (tmp_path / f"{name}.py").write_text(text)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "compiled")}
    call = [sys.executable, "main.py"]
    both = [
        subprocess.Popen(call, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [process.communicate()[0].split() for process in both]
    assert sorted(said) == [["18.0", "False"], ["18.0", "True"]]
    assert [*(tmp_path / "compiled").glob("*.lock")] == []


@pytest.mark.parametrize("home", ["none", "read-only", "writable"])
def test_compiled_code_has_a_place_without_a_home_and_with_a_read_only_package(
    tmp_path, monkeypatch, home
) -> None:
    package, real = kernel_cache.PACKAGE, os.access
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda path, mode: path != package and real(path, mode))
    (tmp_path / "file").touch()  # nobody can make folders in it

    def where() -> Path:
        if home == "none":
            raise RuntimeError("Could not determine home directory.")
        return tmp_path / ("file" if home == "read-only" else "home")

    monkeypatch.setattr(Path, "home", where)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = kernel_cache.folder.__wrapped__()
    if home == "writable":
        assert folder.parent == tmp_path / "home/.cache/stereotruth"
        return
    assert folder.parent == tmp_path / f"stereotruth-{os.getuid()}"
    assert folder.parent.stat().st_mode & 0o077 == 0
    folder.parent.chmod(0o777)  # as if made by somebody else, who could put code there
    assert kernel_cache.folder.__wrapped__().parent != folder.parent
