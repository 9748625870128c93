"""What the documentation shows of Python runs, and says what the pages show."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import open_grid
from stereotruth.project.label_pair import label_pair

from ..synthetic.notebook import BLOCK, NOTEBOOK, code_cells, run_code
from ..synthetic.project import ROOT, Project
from ..synthetic.tutorial import Session, agrees

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(toured: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the example, and its tiles and dataset."""
    folder = tmp_path_factory.mktemp("python")
    demo = Project(Path(shutil.copytree(toured / "demo", folder / "demo")))
    settings = ("--snakefile", str(ROOT / "Snakefile"), "--configfile", "config.yaml")
    run = demo.snakemake("tiles/Demo", "dataset", *settings)
    assert run.status == 0, run.text[-4000:]
    return folder


def test_the_example_is_checked_and_its_page_has_the_exact_truth(toured: Path) -> None:
    session = Session(toured)
    session.run("cd demo")
    status, lines = session.run("stereotruth check")
    assert status == 0 and "0 errors, 0 doubts: a run can begin" in lines[-1], lines
    _, plan = session.run("stereotruth run report --dry-run")
    assert any(re.match(r"evaluate_truth_city +1 +\d+ +\d+ +\d+", line) for line in plan), plan


def said(outputs: list[dict]) -> list[str]:
    texts = ["".join(output["text"]) for output in outputs if "text" in output]
    return "".join(texts).splitlines()


def test_the_notebook_says_what_it_shows(folder: Path, capsys: pytest.CaptureFixture) -> None:
    """And its labels are those of the workflow, to the last bit."""
    cells = code_cells(json.loads(NOTEBOOK.read_text(encoding="utf-8")))
    found = run_code(["".join(cell["source"]) for cell in cells], folder)
    assert "Done: " in capsys.readouterr().err  # the run has told its progress
    for cell, outputs in zip(cells, found):
        assert agrees(said(outputs), said(cell["outputs"])), said(outputs)
        assert len(outputs) == len(cell["outputs"])
    labels = [open_grid(folder / of) for of in (
        "pair/results/project/Pair/Pair-1.zarr", "demo/results/project/Demo/Demo-1.zarr",
    )]  # fmt: skip
    for name in ("disparity", "status", "height"):
        np.testing.assert_array_equal(*(of[name].values for of in labels))


def test_every_example_of_the_page_runs(folder: Path) -> None:
    page = (ROOT / "docs/reference/python.md").read_text(encoding="utf-8")
    examples = BLOCK.findall(page)
    assert len(examples) >= 6
    if (folder / "pair").is_dir():  # of the notebook: the first example finds it made
        shutil.copytree(folder / "pair", folder / "demo/pair")
    for number, example in enumerate(examples):
        (outputs,) = run_code([example], folder / "demo")
        assert outputs, f"example {number} says nothing"


def test_tiles_are_read_by_the_lines_of_the_guide(folder: Path) -> None:
    guide = (ROOT / "docs/how-to/pytorch.md").read_text(encoding="utf-8")
    (outputs,) = run_code([BLOCK.search(guide)[1]], folder / "demo")
    assert len(said(outputs)) == 2 and "(256, 256)" in said(outputs)[0], outputs


def test_what_is_wrong_is_told_as_in_a_run(folder: Path) -> None:
    absent, delivery = folder / "absent.tif", folder / "demo/data/Demo-1"
    with pytest.raises(InputError) as error:
        label_pair(absent, delivery / "right.tif", delivery / "lidar")
    assert str(absent) in str(error.value)
