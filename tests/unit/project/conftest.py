"""A project of one good scene, copied for each test, which runs in it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.project import add_scene, check_scene

from ...synthetic.broken_scenes import good_project

MODELS: dict[str, EpipolarModel] = {}


def fit_once(left, right, *arguments, **options) -> EpipolarModel:
    """The fit of the stage, once for all projects of the same sensors: most of a check's time."""
    sensors = [[sensor.rpc.to_dict(), sensor.affine.tolist()] for sensor in (left, right)]
    key = repr([sensors, arguments])
    if key not in MODELS:
        MODELS[key] = fit_epipolar(left, right, *arguments, **options)
    return MODELS[key]


@pytest.fixture(autouse=True)
def one_fit(monkeypatch) -> None:
    for module in (add_scene, check_scene):
        monkeypatch.setattr(module, "fit_epipolar", fit_once)


@pytest.fixture(scope="session")
def good(tmp_path_factory) -> Path:
    return good_project(tmp_path_factory.mktemp("command") / "good")


@pytest.fixture
def folder(good, tmp_path, monkeypatch) -> Path:
    shutil.copytree(good, tmp_path / "project")
    monkeypatch.chdir(tmp_path / "project")
    return tmp_path / "project"
