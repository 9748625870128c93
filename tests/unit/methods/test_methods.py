"""From a configuration entry to a method: the user's own functions, and what is refused."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from stereobench.methods import kinds
from stereobench.methods.kinds import KINDS, names_of
from stereobench.methods.matcher import Matcher
from stereobench.methods.methods import make_method
from stereobench.methods.sgm import SemiGlobalMatcher
from stereobench.methods.user_methods import FunctionMethod
from stereotruth.core.errors import InputError

MODULE = """
import numpy as np

def constant(left, right, disparity_range, value=3):
    return np.full(left.shape[:2], value, np.int32)

def holes(left, right, disparity_range):
    return np.ma.masked_less(np.ones(left.shape), 2)

def small(left, right, disparity_range):
    return np.zeros((1, 1))

class Whole:
    margin_px = 7
    def __init__(self, gain=1):
        self.gain = gain
    def scaling(self, left, right):
        return self.gain
    def __call__(self, left, right, disparity_range, scaling=None):
        return np.full(left.shape, self.gain, np.float32)
"""
IMAGE = np.ones((2, 3), np.uint16)


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "my_stereo.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_stereo", None)


def function(name, **more):
    return make_method("mine", {"kind": "function", "function": name, **more})


@pytest.mark.parametrize("place", ["my_stereo", "my_stereo.py", "sub/my_stereo.py"])
def test_a_function_of_the_working_directory_is_a_method(here, place):
    (here / "sub").mkdir()
    (here / "sub/my_stereo.py").write_text(MODULE)
    method = function(f"{place}:constant", options={"value": 5}, margin_px=9)
    found = method(IMAGE, IMAGE, (0, 8))
    assert found.dtype == np.float32 and np.all(found == 5)
    assert method.margin_px == 9 and method.scaling(IMAGE, IMAGE) is None
    assert isinstance(method, Matcher)


def test_masked_results_become_nan(here):
    assert np.isnan(function("my_stereo:holes")(IMAGE, IMAGE, (0, 8))).all()


def test_a_class_is_a_method_as_it_is(here):
    method = function("my_stereo:Whole", options={"gain": 4})
    assert method.margin_px == 7 and method.scaling(None, None) == 4
    assert method(IMAGE, IMAGE, (0, 8))[0, 0] == 4


def test_entry_points_are_found(here, monkeypatch):
    point = EntryPoint("theirs", "my_stereo:constant", kinds.ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(here))
    monkeypatch.setattr(
        kinds, "entry_points", lambda group, name: [point] if name == "theirs" else []
    )
    assert np.all(function("theirs")(IMAGE, IMAGE, (0, 8)) == 3)
    with pytest.raises(InputError, match="no entry point 'others'"):
        function("others")


def test_what_cannot_be_found_is_told(here):
    with pytest.raises(InputError, match="cannot import no_such_module"):
        function("no_such_module:f")
    with pytest.raises(InputError, match=r"cannot import nothing\.py"):
        function("nothing.py:f")
    with pytest.raises(InputError, match="has no 'missing'"):
        function("my_stereo:missing")


def test_a_result_of_another_size_is_refused(here):
    with pytest.raises(InputError, match=r"'mine' returned shape \(1, 1\)"):
        function("my_stereo:small")(IMAGE, IMAGE, (0, 8))


def test_sgm_is_made_with_its_settings():
    method = make_method("sgm", {"kind": "sgm", "mode": "3way", "label": "SGM, three paths"})
    assert isinstance(method, SemiGlobalMatcher)
    with pytest.raises(InputError, match=r"kind 'sgm', which has no setting 'windw'.*block_size"):
        make_method("sgm", {"kind": "sgm", "windw": 3})


@pytest.mark.parametrize(
    ("kind", "maker", "told"),
    [
        ("sgm", "sgm:SemiGlobalMatcher", {"workers"}),
        ("pandora", "pandora_pipeline:PandoraMethod", {"name"}),
        ("function", "user_function:_function_method", {"name"}),
        ("command", "user_command:CommandMethod", {"name", "workers"}),
    ],
)
def test_the_settings_of_a_kind_are_those_that_its_maker_takes(kind, maker, told):
    module, _, name = maker.partition(":")
    module = pytest.importorskip(f"stereobench.methods.{module}", exc_type=ImportError)
    taken = set(inspect.signature(getattr(module, name)).parameters) - told
    assert set(KINDS[kind].settings) == taken


def test_the_settings_of_networks_are_those_that_are_read():
    folder = Path(kinds.__file__).parents[1] / "networks"
    read = set(re.findall(r'settings\.get\("(\w+)"\)', (folder / "inference.py").read_text()))
    assert set(KINDS["stereonet"].settings) == read | {"training"}


def test_a_network_has_no_other_settings():
    with pytest.raises(InputError, match=r"no setting 'precison'.*precision"):
        make_method("stereonet", {"kind": "stereonet", "precison": "bfloat16"})


def test_a_setting_that_a_method_lacks_is_told():
    with pytest.raises(InputError, match=r"settings of method 'mine': missing .*'function'"):
        make_method("mine", {"kind": "function"})
    with pytest.raises(InputError, match=r"settings of method 'mine': missing .*'command'"):
        make_method("mine", {"kind": "command"})


def test_unknown_kinds_and_folders_cannot_run():
    with pytest.raises(InputError, match="unknown kind 'raft'"):
        make_method("x", {"kind": "raft"})
    with pytest.raises(InputError, match="folder of results"):
        make_method("x", {"kind": "folder", "folder": "y"})


def test_without_torch_a_network_says_what_to_install(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"needs torch.*the extra networks"):
        make_method("stereonet", {"kind": "stereonet"})


def test_what_a_function_raises_is_not_hidden():
    def broken(left, right, disparity_range):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        FunctionMethod(broken)(IMAGE, IMAGE, (0, 8))


def files(function):
    return [str(path) for path in KINDS["function"].files({"function": function})]


def test_the_files_of_a_function_are_found_without_its_import(here, monkeypatch):
    (here / "pack/sub").mkdir(parents=True)
    for name in ("pack/__init__.py", "pack/stereo.py", "pack/sub/more.py", "pack/notes.txt"):
        (here / name).write_text("raise SystemExit('imported')")
    assert files("my_stereo:constant") == ["my_stereo.py"]
    assert files("sub/mine.py:constant") == ["sub/mine.py"]
    whole = ["pack/__init__.py", "pack/stereo.py", "pack/sub/more.py"]
    assert files("pack.stereo:match") == files("pack:match") == whole
    point = EntryPoint("theirs", "pack.stereo:match", kinds.ENTRY_POINTS)
    monkeypatch.setattr(kinds, "entry_points", lambda group, name: [point])
    assert files("theirs") == whole


@pytest.mark.parametrize(
    ("function", "words"),
    [
        ("no_such_module:f", "cannot import no_such_module"),
        ("sys:exit", "no file holds the code of sys"),
        ("others", "no entry point 'others'"),
    ],
)
def test_a_function_whose_edits_cannot_be_seen_is_refused(here, function, words):
    with pytest.raises(InputError, match=words):
        files(function)


def test_files_are_named_below_the_folder_that_they_share(here):
    paths = [here / "pack/__init__.py", here / "pack/sub/__init__.py"]
    assert names_of(paths) == {"__init__.py": paths[0], "sub/__init__.py": paths[1]}
    assert list(names_of([here / "pack/stereo.py"])) == ["stereo.py"]
