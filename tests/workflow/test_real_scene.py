"""A real Pléiades pair through the workflow, against its check points."""

from __future__ import annotations

import pytest
from figures import evaluate_checkpoints

from stereotruth.evaluate.labels_against_images import warp_scene

from ..synthetic.project import ROOT

SCENE = ROOT.parent / "shared" / "real" / "marseille"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
    pytest.mark.skipif(not SCENE.is_dir(), reason="the real scene is not beside the project"),
]


def test_marseille_agrees_with_its_check_points(project):
    row = {
        "scene": "marseille-1",
        "city": "Marseille",
        "left_image": str(SCENE / "left.tif"),
        "right_image": str(SCENE / "right.tif"),
        "lidar": str(SCENE / "lidar"),
        "gcps": str(SCENE / "gcps.csv"),
    }
    config = project.add_scene("marseille", [row], tiles={"size": 512})
    run = project.snakemake("tiles/Marseille", "--configfile", config)
    assert run.status == 0, run.text[-4000:]
    results = project.folder / "results"
    grid = results / "project/Marseille/marseille-1.zarr"
    figures = evaluate_checkpoints(grid, SCENE / "checkpoints.csv")
    assert figures["count"] > 3000
    assert abs(figures["median"]) <= 0.08
    assert figures["nmad"] <= 0.40
    assert figures["y_parallax_rms"] <= 0.25
    rectified = results / "rectify/Marseille/marseille-1"
    warped = warp_scene(rectified / "left.zarr", rectified / "right.zarr", grid)
    assert warped.sums.coefficient >= 0.98
