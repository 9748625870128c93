"""Projects of a small synthetic city, for the tests of the workflow."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from stereotruth.simulate.__main__ import make_scene

from ..synthetic.project import SIZE, TINY, Project, copy_project, row_of


@pytest.fixture
def project(tmp_path) -> Project:
    return copy_project(tmp_path / "project")


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """The city's files: left.tif, right.tif, lidar/, gcps.csv, truth.zarr."""
    folder = tmp_path_factory.mktemp("data") / "Tiny-1"
    make_scene(TINY, TINY.scenes[0], folder, spacing_m=0.4, seed=1)
    return folder


@pytest.fixture(scope="session")
def made(data, tmp_path_factory) -> Project:
    """A project in which tiles/Tiny has been made, by two cores; config in tiny.yaml."""
    project = copy_project(tmp_path_factory.mktemp("made") / "project")
    shutil.copytree(data, project.folder / "in")
    project.add_scene("tiny", [row_of(Path("in"))], **SIZE)
    run = project.snakemake("tiles/Tiny", "--configfile", "tiny.yaml")
    assert run.status == 0, run.text[-4000:]
    assert "Look at tiles/Tiny/manifest.csv" in run.text
    return project


FUNCTION = """
import cv2
import numpy as np

def match(left, right, disparity_range, block):
    low = -16  # OpenCV leaves as many columns out as the range is wide
    matcher = cv2.StereoSGBM.create(low, 48, block)
    eight = [cv2.convertScaleAbs(image, alpha=0.1) for image in (left, right)]
    disparity = matcher.compute(*eight) / np.float32(16)
    return np.where(disparity < low, np.nan, disparity)
"""
OF_OWN = {"disparity_range": [-64, 64], "methods": ["sgm", "mine", "theirs"]}
FAULTY = {"root": "faulty", "layout": "stereotruth", "disparity_range": [-64, 64]}
SETTINGS = {
    "benchmark": {
        "datasets": {"synthetic": OF_OWN, "faulty": FAULTY},
        "methods": {
            "mine": {"kind": "function", "function": "mine.py:match", "options": {"block": 5}},
            "theirs": {"kind": "folder", "folder": "theirs", "label": "Theirs"},
        },
        "split": None,
        "bootstrap": 100,
        "panels": 1,  # a second of matplotlib each
    },
    "predict": {"block_px": 256, "overlap_px": 32},
}


@pytest.fixture(scope="session")
def tiled(made, tmp_path_factory) -> Project:
    """The project with the city's tiles, and later.yaml beside tiny.yaml: nothing made of it."""
    project = made.copy(tmp_path_factory.mktemp("tiled") / "project")
    (project.folder / "later.yaml").write_text(yaml.safe_dump(SETTINGS))
    (project.folder / "mine.py").write_text(FUNCTION)
    (project.folder / "faulty").mkdir()
    return project


@pytest.fixture(scope="session")
def later(tiled, tmp_path_factory) -> Project:
    """The project in which the stages after the tiles have run, by one call."""
    project = tiled.copy(tmp_path_factory.mktemp("later") / "project")
    run = project.snakemake(
        *("dataset", "report", "audit/synthetic", "benchmark/synthetic/sgm"),
        *("submission/synthetic/sgm", "results/predict/Tiny/Tiny-1/sgm_dsm.tif"),
        *("score_dsm/Tiny/Tiny-1/sgm", "verify"),
        *("--configfile", "tiny.yaml", "later.yaml"),
    )
    assert run.status == 0, run.text[-4000:]
    assert "Traceback" not in run.text
    last = run.text[run.text.rindex("(100%) done") :]
    for words in (
        "Look at results/report/Tiny/index.html",
        "SGM on synthetic: EPE 0.",
        "look at benchmark/synthetic/sgm/cities.csv",
        "Audit of synthetic: ",
        "Look at results/predict/Tiny/Tiny-1/sgm_dsm.tif",
        "Surface model of Tiny-1 by sgm: ",
    ):
        assert words in last
    assert "manifest.csv" not in last  # an earlier run has made the tiles
    return project
