"""The commands that seal, rank and compare, as users call them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from stereobench.scores.prediction_files import FILE
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.core.products.provenance import file_sha256
from stereotruth.project.main import app

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def called(*words: object, status: int = 0) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == status, result.output
    return result.output


def test_a_challenge_from_its_seal_to_its_board(tmp_path):
    rng = np.random.default_rng(0)
    for n in range(2):
        truth = rng.uniform(0, 5, (8, 9)).astype(np.float32)
        for kind, word in (("left", "left"), ("right", "right"), ("disp", "disparity")):
            array = truth if kind == "disp" else np.ones((8, 9), np.uint16)
            write(tmp_path / f"whole/test/{kind}/KM_{word}_{n}.tiff", array)
        write(tmp_path / f"submissions/mine/KM_{n}.tif", truth + np.float32(0.1))
    mine = tmp_path / "submissions/mine"
    facts = {"label": "Mine", "by": "Us", "licence": "MIT", "trained_on": "nothing"}
    files = {file.name: file_sha256(file) for file in mine.iterdir()}
    (mine / FILE).write_text(json.dumps({**facts, "dataset": "toy", "files": files}))
    datasets = {"toy": {"root": "public", "layout": "whu", "disparity_range": [0, 8]}}
    (tmp_path / "board.yaml").write_text(yaml.safe_dump({"datasets": datasets}))
    public = tmp_path / "public"
    said = called("dataset", tmp_path / "whole", "--seal", public, "--layout", "whu")
    seal = json.loads((public / "seal.json").read_text())["id"]
    assert seal in said
    assert isinstance(CliRunner().invoke(app, ["board", str(tmp_path)]).exception, InputError)
    called("dataset", public, "--open", tmp_path / "whole")
    assert "refused: mine" in called("board", tmp_path, status=1)
    called("board", tmp_path, "--admit", "--to", tmp_path / "page")
    assert seal in (tmp_path / "page/index.html").read_text()
    with pytest.raises(InputError):
        CliRunner().invoke(app, ["dataset", str(public)], catch_exceptions=False)


def test_two_folders_of_scores_are_compared(tmp_path):
    for name, epe in (("a", 1.0), ("b", 2.0)):
        rows = [{"tile": n, "labelled": 9, "filled_epe_px": epe + n / 9} for n in range(6)]
        write_table(tmp_path / name / "scores.csv", rows)
    assert "worse, +1.0000" in called("compare", tmp_path / "a", "--with", tmp_path / "b")
