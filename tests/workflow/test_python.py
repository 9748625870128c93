"""What the documentation shows of Python runs, and says what the pages show."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import open_grid
from stereotruth.project.label_pair import label_pair

from ..synthetic.notebook import BLOCK, NOTEBOOK, code_cells, run_code
from ..synthetic.project import ROOT
from ..synthetic.tutorial import Session, agrees

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the example, and its tiles."""
    session = Session(tmp_path_factory.mktemp("python"))
    for command in ("stereotruth init --example demo", "cd demo", "stereotruth run tiles/Demo"):
        status, said = session.run(command)
        assert status == 0, "\n".join(said[-40:])
    return session.place.parent


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


def test_what_is_wrong_is_told_as_in_a_run(folder: Path) -> None:
    absent, delivery = folder / "absent.tif", folder / "demo/data/Demo-1"
    with pytest.raises(InputError) as error:
        label_pair(absent, delivery / "right.tif", delivery / "lidar")
    assert str(absent) in str(error.value)
