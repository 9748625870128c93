"""The programs of bench/ at least start: everything that they take from the package is there."""

from __future__ import annotations

import ast
import importlib
import runpy
from argparse import Namespace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from stereotruth.epipolar.fit import fit_epipolar

from .synthetic.cameras import BACKWARD, FORWARD, HEIGHT, camera
from .synthetic.images import write_image

PROGRAMS = sorted((Path(__file__).parents[1] / "bench").glob("*.py"))


def check(source: str) -> int:
    """Count the names that a program takes from the package, all of which exist."""
    tree, modules, count = ast.parse(source), {}, 0
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stereotruth"):
            for alias in node.names:
                try:
                    value = importlib.import_module(f"{node.module}.{alias.name}")
                except ModuleNotFoundError:
                    value = getattr(importlib.import_module(node.module), alias.name)
                if isinstance(value, ModuleType):
                    modules[alias.asname or alias.name] = value
                count += 1
        elif isinstance(node, ast.Constant) and "from stereotruth" in str(node.value):
            count += check(node.value)  # a program that is handed to other processes
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            assert module is None or hasattr(module, node.attr), f"{node.value.id}.{node.attr}"
    return count


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_what_is_taken_from_the_package_exists_and_programs_start(
    program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert check(program.read_text())
    names = runpy.run_path(str(program), run_name=program.stem)
    if "main" not in names:
        assert any(f"from {program.stem} import" in p.read_text() for p in PROGRAMS)
        return
    monkeypatch.setattr("sys.argv", [str(program), "--help"])
    with pytest.raises(SystemExit) as ended:
        names["main"]()
    assert ended.value.code == 0


def test_the_rates_of_rectification_are_measured(tmp_path: Path) -> None:
    kernel_rates = importlib.import_module("kernel_rates")
    size = (300, 200)
    views = [camera(place, angle=90.0, size=size) for place in (BACKWARD, FORWARD)]
    fit_epipolar(*views, size, size, HEIGHT).save(tmp_path / "epipolar.json")
    write_image(tmp_path / "left.tif", None, np.full(size[::-1], 500, np.uint16))
    rows = kernel_rates.rectification(Namespace(folder=tmp_path, repeats=1, workers=1))
    assert {row["what"] for row in rows} == {
        "remap, bicubic", "remap, Lanczos", "stereotruth", "stereotruth, file to store"
    }  # fmt: skip
    assert all(row["per_s"] > 0 and row["per_cpu_s"] > 0 for row in rows)
