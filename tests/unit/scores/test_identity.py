"""What is told of a method and of the machine."""

from __future__ import annotations

import hashlib
import json
import os
from email.message import Message
from importlib.metadata import PathDistribution, version

import psutil
import pytest

from stereobench.scores.identity import _licence, identity, machine


def test_sgm_is_that_of_opencv():
    found = identity({"kind": "sgm"}, code="abc")
    assert found["version"].startswith("opencv-python") and found["licence"].startswith("Apache")
    assert found["code"] == "abc" and found["files"] == {}


def test_a_function_is_of_its_distribution(tmp_path):
    found = identity({"kind": "function", "function": "scipy.ndimage:shift"})
    assert found["version"] == f"scipy {version('scipy')}" and "BSD" in found["licence"]
    of_a_file = identity({"kind": "function", "function": "mine.py:f"})
    assert of_a_file["version"] is of_a_file["licence"] is of_a_file["code"] is None


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("MIT\n", "MIT"),
        ("\n   Apache License\n  Version 2.0, January 2004\n\nTERMS", "Apache License 2.0"),
        ("BSD 3-Clause License\n\nCopyright (c) somebody", "BSD 3-Clause License"),
        ("Copyright (c) somebody\n\nRedistribution and use", None),
        ("", None),
    ],
)
def test_a_licence_has_the_name_that_its_text_begins_with(tmp_path, monkeypatch, text, name):
    about = Message()
    about["Name"], about["License"] = "theirs", text
    monkeypatch.setattr(PathDistribution, "metadata", about)
    assert _licence(PathDistribution(tmp_path)) == name


@pytest.mark.parametrize("pipeline", [None, "mccnn"])
def test_pandora_has_its_licence_and_that_of_its_weights(pipeline):
    pytest.importorskip("pandora", reason="needs the extra pandora")
    if pipeline:
        pytest.importorskip("mc_cnn", reason="needs the extra mccnn")
    found = identity({"kind": "pandora", "pipeline": pipeline})
    assert found["version"].startswith("pandora ") and "Apache" in found["licence"]
    assert ("mccnn" in found["version"].casefold()) == bool(pipeline)


@pytest.mark.parametrize("kind", ["command", "stereonet", "sgm", "folder"])
def test_what_the_entry_says_counts_and_files_have_checksums(tmp_path, kind):
    for name in ("weights.pt", "code/infer.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    files = [tmp_path / "weights.pt", tmp_path / "code/infer.py"]
    found = identity({"kind": kind, "licence": "MIT", "version": "2.1"}, files)
    assert (found["licence"], found["version"]) == ("MIT", "2.1")
    assert found["files"] == {
        name: hashlib.sha256(name.encode()).hexdigest() for name in ("weights.pt", "code/infer.py")
    }
    other = identity({"kind": kind})
    assert kind == "sgm" or other["licence"] is other["version"] is None


def test_the_machine_is_told():
    found = machine()
    assert 1 <= found["cores"] <= os.cpu_count() and found["processor"]
    assert found["memory_gib"] == pytest.approx(psutil.virtual_memory().total / 2**30, abs=0.1)
    json.dumps(found)
