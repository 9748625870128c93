"""How numerics are compiled: what Python and what kernels call, and what compiles them again."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stereotruth.core import kernels
from stereotruth.core.kernels import inlined, inner, kernel

HOUSE = Path(__file__).parents[3] / "src"
FILES = {
    "made/__init__.py": "",
    "made/uses.py": """
from typing import NamedTuple
import numpy as np
from stereotruth.core.kernels import kernel
from .parts import (
    LEAST,
    shifted,
)

class Line(NamedTuple):
    slope: float
    level: float

@kernel
def total(values, line):
    kept = np.zeros(1)
    for value in values:
        kept[0] += max(shifted(value), LEAST) * line.slope
    return kept[0]
""",
    "made/parts.py": """
from stereotruth.core.kernels import inner
from . import deeper

LEAST = 0.5

@inner
def shifted(value):
    return deeper.moved(value) + 1.0
""",
    "made/deeper.py": """
from stereotruth.core.kernels import inlined

@inlined
def moved(value):
    return value + 2.0
""",
    "made/apart.py": "FAR = 1.0\n",
    "main.py": """
import logging, sys
import numpy as np
logging.basicConfig(format="%(message)s", stream=sys.stdout, level=logging.INFO)
from made import apart
from made.uses import Line, total
values = np.array([1.0, 2.0], sys.argv[1])
print(total(values, Line(2.0, 5.0)), total(values, Line(2.0, 5.0)))
""",
}
SAID = "compiling, once"


@pytest.fixture
def run(tmp_path):
    """Runs the program in a process of its own after an edit; ``True`` where it compiled."""

    def start(edit: tuple[str, str, str] | None = None, dtype="float64") -> subprocess.Popen:
        for name, text in FILES.items():
            if edit and edit[0] == name:
                assert text.count(edit[1]) == 1
                text = text.replace(*edit[1:])
            (tmp_path / name).parent.mkdir(exist_ok=True)
            # a process that is still importing must not meet a file half written
            if not (tmp_path / name).exists() or (tmp_path / name).read_text() != text:
                (tmp_path / name).write_text(text)
        return subprocess.Popen(
            [sys.executable, "main.py", dtype], cwd=tmp_path, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"},
        )  # fmt: skip

    return start


def result(process: subprocess.Popen) -> tuple[float, bool]:
    """What a program computed, twice the same, and whether it said once that it compiles."""
    *said, values = process.communicate()[0].splitlines()
    assert said[:1] in ([], [SAID]) and process.returncode == 0
    first, second = map(float, values.split())
    assert first == second
    return first, bool(said)


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
    assert {str(file.relative_to(HOUSE)) for file in files} == {"stereotruth/core/kernels.py"}


def test_sources_are_those_of_all_modules_that_a_module_imports() -> None:
    """Whatever else a process has imported: else each would compile for itself."""
    importlib.import_module("stereotruth.project.main")  # nearly all
    for module in (
        "stereotruth.align.label_uncertainty",
        "stereotruth.labels.crowns",
        "stereotruth.lidar.ingest",
    ):
        importlib.import_module(module)
        modules = kernels.source_modules(module)
        script = f"import {module} as m, stereotruth.core.kernels as k; "
        script += f"print(*k.source_modules('{module}'))"
        alone = subprocess.check_output([sys.executable, "-c", script], text=True)
        assert alone.split() == modules
        assert {"stereotruth.core.kernels", module} < set(modules)


@pytest.mark.slow
def test_an_edit_of_what_a_kernel_calls_compiles_it_and_another_edit_does_not(run) -> None:
    assert result(run()) == (18.0, True)  # ((1 + 3) + (2 + 3)) * 2
    assert result(run()) == (18.0, False)
    assert result(run(("made/apart.py", "1.0", "2.0"))) == (18.0, False)
    assert result(run(("made/parts.py", "+ 1.0", "+ 3.0"))) == (26.0, True)
    assert result(run(("made/deeper.py", "+ 2.0", "- 2.0"))) == (3.0, True)
    assert result(run(("made/parts.py", "0.5", "9.5"))) == (38.0, True)
    fields = ("made/uses.py", "slope: float\n    level: float", "level: float\n    slope: float")
    assert result(run(fields)) == (45.0, True)  # fields are known by number
    assert result(run()) == (18.0, False)  # taken back


def test_the_place_of_compiled_code_is_claimed_for_what_is_kept_alone(monkeypatch) -> None:
    """Else processes would wait while one compiles what its kernel calls."""
    claims = []
    monkeypatch.setattr(kernels, "_claim", lambda: claims.append(True))
    for function in (shifted, summed.py_func):
        compiled = SimpleNamespace(
            kind="numba:compile", data={"dispatcher": SimpleNamespace(py_func=function)}
        )
        kernels._compilation.on_end(compiled)
        assert bool(claims) == (function is summed.py_func)


@pytest.mark.slow
def test_a_wheel_brings_kernels_along_for_all_processors_of_the_target(run, tmp_path) -> None:
    """Whatever the folder in which the package is installed, and the one where it keeps them."""
    assert result(run()) == (18.0, True)
    (digest,) = (tmp_path / "kernels").glob("*/")
    shipped, elsewhere = tmp_path / "shipped", tmp_path / "elsewhere"
    (tmp_path / "kernels").rename(shipped)
    for name in FILES:
        (elsewhere / name).parent.mkdir(exist_ok=True, parents=True)
        shutil.move(tmp_path / name, elsewhere / name)
    main = elsewhere / "main.py"
    ship = (
        f"from stereotruth.core import kernels\nkernels.SHIPPED = kernels.Path({str(shipped)!r})\n"
    )
    main.write_text(ship + main.read_text())
    command = [sys.executable, "main.py", "float64"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(elsewhere), "PYTHONDONTWRITEBYTECODE": "1"}
    text = subprocess.check_output(command, cwd=elsewhere, env=environment, text=True)
    assert text.split() == ["18.0", "18.0"]  # and not a word of compiling
    assert (elsewhere / "kernels" / digest.name).is_dir()


@pytest.mark.slow
def test_processes_that_compile_at_the_same_time_all_keep_it(run) -> None:
    """Of several types too: Numba has one index for all of them."""
    types = ("float64", "float32", "int64", "int32")
    assert [result(one) for one in [run(dtype=t) for t in types]] == [(18.0, True)] * 4
    assert [result(run(dtype=t)) for t in types] == [(18.0, False)] * 4


def test_compiled_code_has_a_place_without_a_home_and_with_a_read_only_package(
    tmp_path, monkeypatch
) -> None:
    (tmp_path / "file").touch()  # nobody can make folders in it
    monkeypatch.setattr(kernels.config, "CACHE_DIR", str(tmp_path / "file" / "named"))
    monkeypatch.setattr(kernels, "PACKAGE", tmp_path / "file")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    assert kernels.folder.__wrapped__().parent == tmp_path / "home/.cache/stereotruth"
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "file")
    folder = kernels.folder.__wrapped__()
    assert folder.parent == tmp_path / f"stereotruth-{os.getuid()}"
    assert folder.parent.stat().st_mode & 0o077 == 0
    folder.parent.chmod(0o777)  # as if made by somebody else, who could put code there
    assert kernels.folder.__wrapped__().parent != folder.parent
