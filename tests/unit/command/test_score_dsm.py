"""A surface model judged by the program, against LiDAR files of a simulated town."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from stereotruth.command.main import app
from stereotruth.command.score_dsm import score_dsm
from stereotruth.errors import InputError
from stereotruth.simulate.cities import lidar_files
from stereotruth.simulate.lidar import simulate_lidar_tile

from ...synthetic.exact_surface import exact_heights, write_heights
from ...synthetic.small_cities import TOWN


@pytest.mark.slow
def test_a_model_is_judged_against_lidar_without_a_project(tmp_path):
    scene = TOWN.scenes[0]
    for name in lidar_files(TOWN, scene):
        simulate_lidar_tile(TOWN, scene, name, tmp_path / "lidar" / name, spacing_m=0.5, seed=1)
    heights, _, west, north = exact_heights(TOWN, scene, 0.65, east=1.3, north=-0.7)
    model = write_heights(tmp_path / "dsm.tif", heights + 0.5, west, north, 0.65, TOWN.epsg)
    arguments = ["score-dsm", str(model), "--lidar", str(tmp_path / "lidar")]
    run = CliRunner().invoke(app, [*arguments, "--to", str(tmp_path / "verdict")])
    assert run.exit_code == 0, run.output
    assert "of its reference" in run.output and "index.html" in run.output
    found = json.loads((tmp_path / "verdict" / "scores.json").read_text())
    for name, planted in (("east_m", 1.3), ("north_m", -0.7), ("up_m", 0.5)):
        assert abs(found["registration"][name] - planted) < 0.05
    assert found["errors"]["ground, off steps"]["nmad_m"] < 0.1
    page = (tmp_path / "verdict" / "index.html").read_text()
    assert "Edges of roofs" in page and 'src="data:image' in page
    assert (tmp_path / "verdict" / "errors.csv").read_text().startswith("stratum,points")


def test_one_reference_is_needed(tmp_path):
    with pytest.raises(InputError, match="--lidar or --reference"):
        score_dsm(tmp_path / "dsm.tif", tmp_path / "to")
    with pytest.raises(InputError, match="no LiDAR file"):
        score_dsm(tmp_path / "dsm.tif", tmp_path / "to", lidar=str(tmp_path / "none"))
