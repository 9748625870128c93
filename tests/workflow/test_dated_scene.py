"""A scene of three dates through the whole workflow: the layer change against exact truth."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr

from stereocities.cities import Dates
from stereocities.sites import make_scene
from stereocities.surfaces import WATER
from stereocities.truth import REASONS, changes_at
from stereotruth.core.status import Status, is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.epipolar_truth import truth_window

from ..synthetic.project import SIZE, TINY, row_of

CITY = replace(
    TINY,
    scenes=(replace(TINY.scenes[0], rows=400, cols=400),),
    dates=Dates(1000.0, 1001.0, 0.0, built=0.3, demolished=0.3, felled=0.3),
)
GRID = "results/project/Tiny/Tiny-1.zarr"
CHANGED_M, SAME_M = 1.0, 0.01


@pytest.mark.slow
def test_what_changed_since_the_lidar_is_found_and_named(project, tmp_path) -> None:
    """Sheets, images and LAZ in; out of the last grid as the bench asks, with some room."""
    (spec,) = CITY.scenes
    make_scene(CITY, spec, tmp_path / "made", spacing_m=0.5, seed=1)
    shutil.copytree(tmp_path / "made", project.folder / "in")
    config = project.add_scene("tiny", [row_of(Path("in"))], **SIZE)
    run = project.snakemake(GRID, "--configfile", config)
    assert run.status == 0, run.text[-4000:]

    grid = zarr.open_group(project.folder / GRID, mode="r")
    status, change = grid["status"][:], grid["change"][:]
    y, x = np.indices(status.shape).astype(np.float64)
    model = EpipolarModel.from_dict(grid.attrs["epipolar"])
    truth = changes_at(CITY, spec, *model.epipolar_to_left(x, y))
    seen = truth_window(model, CITY, spec, *(slice(0, side) for side in status.shape))
    with np.errstate(invalid="ignore"):
        rise = np.abs(truth["height"] - truth["height_lidar"])
    known = is_labelled(status)
    has_points = ~np.isin(status, (Status.NO_POINTS, Status.OUT_OF_FRAME))
    changed, same = has_points & (rise > CHANGED_M), has_points & (rise < SAME_M)
    same &= (seen["visible"] == 1) & (seen["surface"] != WATER)
    assert (changed & ~known).sum() > 0.9 * changed.sum() > 1000
    assert (same & (status == Status.CHANGED)).sum() < 0.03 * same.sum()
    found = changed & (status == Status.CHANGED)
    assert (change[found] == truth["reason"][found]).mean() > 0.85
    named = {REASONS.split()[code] for code in np.unique(change[found])}
    assert {"built", "demolished", "grown_or_felled"} <= named
    assert (change[status != Status.CHANGED] == 0).all()
