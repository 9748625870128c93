"""A project of one good scene, copied for each test, which runs in it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ...synthetic.broken_scenes import good_project


@pytest.fixture(scope="session")
def good(tmp_path_factory) -> Path:
    return good_project(tmp_path_factory.mktemp("command") / "good")


@pytest.fixture
def folder(good, tmp_path, monkeypatch) -> Path:
    shutil.copytree(good, tmp_path / "project")
    monkeypatch.chdir(tmp_path / "project")
    return tmp_path / "project"
