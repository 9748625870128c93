"""The right image warped by the labels of a scene."""

from __future__ import annotations

import numpy as np
from figures import draw_panels

from stereotruth.core.products import grids
from stereotruth.epipolar import warping
from stereotruth.evaluate.labels_against_images import warp_scene
from stereotruth.tiles import tile_checks

from ...synthetic.truth_scene import write_disparity

# ------------------------------------------------------------------------------------ warping


def texture(x, y):
    return 1000 + 200 * np.sin(x / 5.0 + 0.02 * y) + 150 * np.cos(y / 7.0 - x / 11.0)


def test_warping_finds_the_left_image_again(scene, tmp_path):
    shape = scene.model.shape
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    disparity = 3.3 + 0.02 * x
    disparity[:, 50:60] = np.nan
    right_x = x  # right(x_r) = texture at the left position x with x − d(x) = x_r
    right = texture((right_x + 3.3) / 0.98, y)
    layer = grids.Layer("uint16", 0, {"units": "DN", "long_name": "image"})
    stores = []
    for name, image in (("left", texture(x, y)), ("right", right)):
        with grids.atomic_store(tmp_path / f"{name}.zarr") as scratch:
            arrays = grids.create_grid(
                scratch, shape, {"image": layer}, chunk=128, shard=256, attrs={}
            )
            arrays["image"][:] = np.rint(image).astype("uint16")
        stores.append(tmp_path / f"{name}.zarr")
    right_way = write_disparity(scene, tmp_path / "d.zarr", disparity)
    sums = warp_scene(*stores, right_way).sums
    assert sums.coefficient > 0.9999
    assert sums.count > 0.9 * disparity.size * (shape[1] - 20) / shape[1]
    wrong_way = write_disparity(scene, tmp_path / "e.zarr", -disparity)
    assert warp_scene(*stores, wrong_way).sums.coefficient < 0.9

    values = np.rint(texture(x, y))[:64, :64]
    tile = tile_checks.WarpedTile(
        "T_1",
        values,
        warping.warp_rows(np.rint(right)[:64], (x - disparity)[:64, :64]),
        disparity[:64, :64],
    )
    assert tile.correlation > 0.9999
    draw_panels(tile, tmp_path / "panels" / "T_1.png")
    assert [p.name for p in (tmp_path / "panels").iterdir()] == ["T_1.png"]
