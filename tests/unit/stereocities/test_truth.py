"""Exact truth of the views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from stereocities.camera import locate, project, rays
from stereocities.render import prepare
from stereocities.surfaces import terrain_heights
from stereocities.truth import open_truth, simulate_truth

from ...synthetic.small_cities import GROUND, NONE, ONE_BOX, ROOF, TOWN, TREE, WALL


def test_truth_is_on_the_rays_and_in_the_right_image(town: Path) -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    truth = open_truth(town / "truth.zarr")
    surface = truth.surface.values
    assert set(np.unique(surface)) >= {NONE, GROUND, ROOF, WALL, TREE}
    rows, cols = np.nonzero(surface)
    some = np.random.default_rng(3).choice(len(rows), 5000, replace=False)
    rows, cols = rows[some], cols[some]
    xyz = ready.frame.from_geodetic(
        np.column_stack([truth[n].values[rows, cols] for n in ("lon", "lat", "height")])
    )
    left = project(ready.left.cam, xyz)
    assert np.abs(left - np.column_stack([cols, rows])).max() < 1e-4
    right = np.column_stack(
        [truth.right_col.values[rows, cols], truth.right_row.values[rows, cols]]
    )
    assert np.abs(project(ready.right.cam, xyz) - right).max() < 1e-4
    ground = surface[rows, cols] == GROUND
    z = terrain_heights(ready.surfaces, xyz[ground, :2])[:, 0]
    assert np.abs(z - xyz[ground, 2]).max() < 1e-3
    collar = surface == NONE
    with rasterio.open(town / "left.tif") as image:
        assert ((image.read(1) == 0) == collar).all()
    assert np.isnan(truth.lon.values[collar]).all() and not truth.visible_right.values[collar].any()


def test_right_view_hides_what_a_box_covers(tmp_path: Path) -> None:
    """Ground hidden behind one box: the box's shadow along the right rays, its area by hand."""
    scene = ONE_BOX.scenes[0]
    simulate_truth(ONE_BOX, scene, tmp_path / "truth.zarr")
    truth = open_truth(tmp_path / "truth.zarr")
    surface, seen = truth.surface.values, truth.visible_right.values == 1
    ready = prepare(ONE_BOX, scene)
    length, width, height = ONE_BOX.single_box[2:]
    pixel = np.linalg.det(
        np.diff(locate(ready.left.cam, ready.frame, [[210, 200], [211, 200], [210, 201]],
                       np.full(3, 1864.0))[[0, 1, 0, 2], :2], axis=0)[::2]
    )  # fmt: skip
    _, toward = rays(ready.right.cam, [[ready.right.cols / 2, ready.right.rows / 2]])
    hidden = ((surface == GROUND) & ~seen).sum() * abs(pixel)
    expected = height * (abs(toward[0, 0]) * width + abs(toward[0, 1]) * length)
    assert hidden == pytest.approx(expected, rel=0.03)
    roof = surface == ROOF
    # the roof is nearer to the camera than the ground, by 50 m of 505 km
    assert roof.sum() * abs(pixel) == pytest.approx(length * width, rel=0.02)
    assert seen[roof].all()
    assert np.ptp(truth.height.values[roof]) < 1e-3  # level, but for the Earth's curvature
    assert not truth.changed.values.any()
