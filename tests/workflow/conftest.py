"""Projects of a small synthetic city, for the tests of the workflow."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from stereocities.sites import make_scene

from ..synthetic.project import SIZE, TINY, Project, copy_project, row_of
from ..synthetic.tutorial import PAGE, Session, commands


@pytest.fixture
def project(tmp_path) -> Project:
    return copy_project(tmp_path / "project")


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Callable[[str, Callable[[Path], None]], Path]:
    """A way to make a folder once for all test processes: the others wait for the first."""
    top = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        top = top.parent

    def made_once(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = top / f"once_{name}", top / f"once_{name}.done"
        with (top / f"once_{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of a process that has failed
                make(folder)
                done.touch()
        return folder

    return made_once


@pytest.fixture(scope="session")
def data(once) -> Path:
    """The city's files: left.tif, right.tif, lidar/, gcps.csv, truth.zarr."""

    def make(folder: Path) -> None:
        make_scene(TINY, TINY.scenes[0], folder / "Tiny-1", spacing_m=0.4, seed=1)

    return once("data", make) / "Tiny-1"


@contextmanager
def without_utf8() -> Iterator[None]:
    """The poorest environment for what runs say: signs that ASCII lacks end none of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LC_ALL", "C")
        patch.setenv("PYTHONUTF8", "0")
        yield


@pytest.fixture(scope="session")
def made(data, once, tmp_path_factory) -> Project:
    """A project in which tiles/Tiny has been made, by two cores; config in tiny.yaml.

    Each test process has a copy, since a plan writes into the folder, too. Its jobs are forks; as
    users do, ``later`` goes on from it.
    """

    def make(folder: Path) -> None:
        project = copy_project(folder)
        shutil.copytree(data, project.folder / "in")
        project.add_scene("tiny", [row_of(Path("in"))], **SIZE)
        with without_utf8():
            run = project.snakemake("tiles/Tiny", "--configfile", "tiny.yaml")
        assert run.status == 0, run.text[-4000:]
        assert "Look at tiles/Tiny/manifest.csv" in run.text

    return Project(once("made", make)).copy(tmp_path_factory.mktemp("made") / "project")


@pytest.fixture(scope="session")
def toured(once) -> Path:
    """A folder after the commands of docs/tutorial.md; said.json: status and lines of each."""

    def make(folder: Path) -> None:
        folder.mkdir()
        session = Session(folder)
        said = [session.run(command) for command, _ in commands(PAGE.read_text("utf-8"))]
        (folder / "said.json").write_text(json.dumps(said))

    return once("toured", make)


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


AFTER_THE_TILES = (
    *(
        "dataset",
        "report",
        "evaluate",
        "audit/synthetic",
        "benchmark/synthetic/sgm",
        "submission/synthetic/sgm",
    ),
    *("results/predict/Tiny/Tiny-1/sgm_dsm.tif", "score_dsm/Tiny/Tiny-1/sgm"),
)


@pytest.fixture(scope="session")
def later(tiled, once, tmp_path_factory) -> Project:
    """The project in which the stages after the tiles have run, by one call."""

    def make(folder: Path) -> None:
        project, settings = tiled.copy(folder), ("--configfile", "tiny.yaml", "later.yaml")
        with without_utf8():
            run = project.snakemake(*AFTER_THE_TILES, "verify", *settings, as_users_do=True)
        assert run.status == 0, run.text[-4000:]
        assert "Traceback" not in run.text and "UnicodeEncodeError" not in run.text
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
        assert project.plan(*AFTER_THE_TILES, *settings) == {}  # a second call runs nothing

    return Project(once("later", make)).copy(tmp_path_factory.mktemp("later") / "project")
