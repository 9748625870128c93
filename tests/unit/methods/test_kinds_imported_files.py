from __future__ import annotations

from pathlib import Path

import pytest

from stereobench.methods.kinds import KINDS, imported_files

PACK = {"pack/__init__.py", "pack/deep.py"}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("helper.py", "pack/__init__.py", "pack/deep.py", "code/near.py", "lib/far.py"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "lib"))
    return tmp_path


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import helper", {"helper.py"}),
        ("from helper import match", {"helper.py"}),
        ("def match():\n    import helper as h", {"helper.py"}),
        ("try:\n    import pack.deep\nexcept ImportError: pass", PACK),
        ("from pack import deep", PACK),
        ("import importlib\nimportlib.import_module('pack.deep')", PACK),
        ("__import__('helper')", {"helper.py"}),
        ("from runpy import run_path\nrun_path('helper.py')", {"helper.py"}),
        ("import near", {"code/near.py"}),
        ("from . import near", {"code/near.py"}),
        ("import far", {"lib/far.py"}),
        ("import numpy, os.path", set()),
        ("def broken(", set()),
    ],
)  # fmt: skip
def test_all_forms_of_an_import_are_followed(here, text, expected):
    Path("code/mine.py").write_text(text)
    found = {str(f.absolute().relative_to(here)) for f in imported_files([Path("code/mine.py")])}
    assert found == {"code/mine.py", *expected}


def test_one_imports_the_other_and_that_the_first():
    Path("mine.py").write_text("import helper")
    Path("helper.py").write_text("import mine, pack.deep")
    files = KINDS["function"].files({"function": "mine.py:match"})
    assert list(map(str, files)) == ["helper.py", "mine.py", "pack/__init__.py", "pack/deep.py"]
