"""A surface model judged by the program, against LiDAR files of a simulated town."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from stereotruth.core.errors import InputError
from stereotruth.evaluate.surface_models import score
from stereotruth.project.judge import score_dsm
from stereotruth.project.main import app

from ...synthetic.analytic_town import CELL_M, Town
from ...synthetic.exact_surface import write_heights


def test_one_reference_is_needed(tmp_path):
    with pytest.raises(InputError, match="--lidar or --reference"):
        score_dsm(tmp_path / "dsm.tif", tmp_path / "to")
    with pytest.raises(InputError, match="no LiDAR file"):
        score_dsm(tmp_path / "dsm.tif", tmp_path / "to", lidar=str(tmp_path / "none"))
    with pytest.raises(InputError, match="--epoch"):
        score_dsm(tmp_path / "dsm.tif", tmp_path / "to", lidar="a", epoch="May")


IN_ITRF = (-1.478, 0.322, -0.317)  # NAD83(2011) in ITRF2020 at 2020.0, by PROJ: east, north, up (m)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "other", "option", "sign"),
    [(6339, 32610, "reference", 1), (32610, 6339, "lidar", -1)],
)
def test_national_frames_are_brought_to_one(tmp_path, monkeypatch, model, other, option, sign):
    """The same numbers in NAD83(2011) and in WGS 84 are places 1.5 m apart; zone 10N, Seattle."""
    monkeypatch.setattr(score, "GROUPS", 2)  # of the jackknife, whose σ nobody asks for here
    files = {}
    for name, epsg in (("model", model), ("other", other)):
        place = (500_000.0, 5_272_000.0, CELL_M, epsg)
        files[name] = write_heights(tmp_path / f"{name}.tif", Town().heights(), *place)
    given = files["other"] if option == "reference" else str(files["other"])
    arguments = [
        "score-dsm",
        str(files["model"]),
        f"--{option}",
        str(given),
        "--epoch",
        "2020-01-01",
    ]
    to = ["--epoch", "2020-01-01", "--to", str(tmp_path / "to")]
    run = CliRunner().invoke(app, [*arguments, *to])
    assert run.exit_code == 0 and "index.html" in run.output
    found = json.loads((tmp_path / "to" / "scores.json").read_text())["registration"]
    for name, metres in zip(("east_m", "north_m", "up_m"), IN_ITRF):
        assert found[name] == pytest.approx(sign * metres, abs=0.03)
