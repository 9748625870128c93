"""Our registration of surface models and that of xdem: both find a shift that was planted."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from stereotruth.evaluate.surface_models.reference import RasterReference
from stereotruth.evaluate.surface_models.score import score_surface_model

from ....synthetic.analytic_town import Town, write

EAST_M, NORTH_M, UP_M = 2.37, -1.41, 0.83  # of the grid
WITHIN_M = 0.03
BY_XDEM = """
import json, sys, xdem
reference, model = map(xdem.DEM, sys.argv[1:])
found = xdem.coreg.NuthKaab().fit(reference, model, random_state=1).to_matrix()
print(json.dumps((-found[:3, 3]).tolist()))  # what is planted, not what corrects it
"""


@pytest.fixture(scope="module")
def python_of_xdem(tmp_path_factory) -> Path:
    """Of an environment of its own: xdem wants an older pandas than other packages here."""
    folder, uv = tmp_path_factory.mktemp("xdem"), [sys.executable, "-m", "uv"]
    python = folder / "bin" / "python"
    subprocess.run([*uv, "venv", "--clear", "--python", sys.executable, folder], check=True)
    install = [*uv, "pip", "install", "--python", python, "xdem==0.2.3"]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"xdem cannot be installed: {done.stderr[-300:]}")
    return python


@pytest.mark.slow
def test_both_find_what_was_planted(tmp_path, python_of_xdem):
    town = Town(boxes=4, hills_m=5.0)
    reference = write(tmp_path / "reference.tif", town.heights())
    model = write(tmp_path / "model.tif", town.heights(EAST_M, NORTH_M) + UP_M)
    plain = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [python_of_xdem, "-c", BY_XDEM, reference, model]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=plain)
    planted = pytest.approx([EAST_M, NORTH_M, UP_M], abs=WITHIN_M)
    assert json.loads(done.stdout.splitlines()[-1]) == planted
    found = score_surface_model(model, RasterReference(reference)).figures()["registration"]
    assert [found[f"{name}_m"] for name in ("east", "north", "up")] == planted
