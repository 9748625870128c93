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
def test_what_is_taken_from_the_package_exists(program: Path) -> None:
    if "stereotruth.matching.networks" in program.read_text():
        pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
    assert check(program.read_text())
    names = runpy.run_path(str(program), run_name=program.stem)
    taken = f"from {program.stem} import"
    assert callable(names.get("main")) or any(taken in p.read_text() for p in PROGRAMS)


def test_the_rates_of_rectification_are_measured(tmp_path: Path) -> None:
    throughput = importlib.import_module("throughput")
    size = (300, 200)
    views = [camera(place, angle=90.0, size=size) for place in (BACKWARD, FORWARD)]
    fit_epipolar(*views, size, size, HEIGHT).save(tmp_path / "epipolar.json")
    write_image(tmp_path / "left.tif", None, np.full(size[::-1], 500, np.uint16))
    rows = throughput.rectification(Namespace(folder=tmp_path, repeats=1, workers=1))
    assert {row["what"] for row in rows} == {
        "remap, bicubic", "remap, Lanczos", "stereotruth", "stereotruth, file to store"
    }  # fmt: skip
    assert all(row["per_s"] > 0 and row["per_cpu_s"] > 0 for row in rows)
