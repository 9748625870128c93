"""Which files a method is made of, found without running any of them."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from stereobench.methods import kinds
from stereobench.methods.kinds import KINDS, names_of
from stereotruth.core.errors import InputError

PACK = {"pack/__init__.py", "pack/deep.py"}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("helper.py", "pack/__init__.py", "pack/deep.py", "code/near.py", "lib/far.py"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("raise SystemExit('imported')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "lib"))
    return tmp_path


def files(function: str) -> set[str]:
    return {str(path) for path in KINDS["function"].files({"function": function})}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("def match():\n    import helper as h", {"helper.py"}),
        ("try:\n    from pack import deep\nexcept ImportError: pass", PACK),
        ("import importlib\nimportlib.import_module('pack.deep')", PACK),
        ("from runpy import run_path\nrun_path('helper.py')", {"helper.py"}),
        ("from . import near", {"code/near.py"}),
        ("import far", {"lib/far.py"}),
        ("import numpy, os.path", set()),
        ("def broken(", set()),
    ],
)
def test_all_forms_of_an_import_are_followed(here, text, expected):
    Path("code/mine.py").write_text(f"{text}\nmatch = None")
    found = {str(Path(f).absolute().relative_to(here)) for f in files("code/mine.py:match")}
    assert found == {"code/mine.py", *expected}


def test_files_of_functions_commands_and_entry_points(monkeypatch):
    Path("mine.py").write_text("import helper as match")
    Path("helper.py").write_text("import mine, pack.deep")
    assert files("mine.py:match") == {"mine.py", "helper.py", *PACK}
    assert files("pack.deep:match") == files("pack:match") == PACK
    point = EntryPoint("theirs", "pack.deep:match", kinds.ENTRY_POINTS)
    monkeypatch.setattr(
        kinds, "entry_points", lambda group, name: [point] if name == "theirs" else []
    )
    assert files("theirs") == PACK
    settings = {"command": "python helper.py --weights mine.py {left}", "files": ["more.py"]}
    assert KINDS["command"].files(settings) == [Path(f"{n}.py") for n in ("helper", "mine", "more")]
    for wrong in ("no_such_module:f", "sys:exit", "others"):
        with pytest.raises(InputError):
            files(wrong)


@pytest.mark.parametrize(
    "text",
    [
        "class match: pass",
        "if True:\n    async def match(): pass",
        "a, match = 0, 1",
        "from pack import other as match",
        "from pack import *",
        "from pack import *  # noqa: F403",
        "from pack import *; a = 0",
        "def __getattr__(name): return len",
        "globals()['mat' + 'ch'] = 0",
    ],
)
def test_a_function_that_may_be_there_is_not_refused(text):
    Path("mine.py").write_text(text)
    files("mine.py:match")


def test_a_function_or_program_that_is_not_there_is_refused():
    Path("mine.py").write_text("def matching(): pass")
    with pytest.raises(InputError) as refused:
        files("mine.py:match")
    assert "matching" in refused.value.remedy
    with pytest.raises(InputError):
        KINDS["command"].files({"command": "no_such_program {left} {right} {out}"})


def test_a_program_of_this_folder_is_found():
    Path("own").write_text("#!/bin/sh\n")
    Path("own").chmod(0o755)
    assert KINDS["command"].files({"command": "./own {left} {right} {out}"}) == [Path("own")]


def test_files_are_named_below_the_folder_that_they_share(here):
    paths = [here / "pack/__init__.py", here / "pack/sub/__init__.py"]
    assert names_of(paths) == {"__init__.py": paths[0], "sub/__init__.py": paths[1]}
