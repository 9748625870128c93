"""The RPCs that are shipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import RPCTransformer

from stereocities.camera import locate
from stereocities.render import prepare

from ...synthetic.small_cities import TOWN


def test_rpcs_are_the_camera_up_to_an_affine(town: Path) -> None:
    """Through GDAL's own RPC code: bias apart, below 0.01 px; bias of several px."""
    ready = prepare(TOWN, TOWN.scenes[0])
    for view, camera in (("left", ready.left), ("right", ready.right)):
        rng = np.random.default_rng(2)
        colrow = rng.uniform(0, 1, (300, 2)) * [camera.cols, camera.rows]
        xyz = locate(camera.cam, ready.frame, colrow, rng.uniform(-60, 160, 300))
        lon, lat, height = ready.frame.to_geodetic(xyz).T
        with rasterio.open(town / f"{view}.tif") as image:
            assert (image.width, image.height) == (camera.cols, camera.rows)
            assert image.nodata == 0 and image.dtypes == ("uint16",)
            row, col = RPCTransformer(image.rpcs).rowcol(lon, lat, height, op=lambda v: v)
        found = np.column_stack([col, row]) - 0.5  # GDAL counts from the pixel's corner
        biased = colrow @ camera.rpc.bias[:, :2].T + camera.rpc.bias[:, 2]
        assert np.abs(found - biased).max() < 0.01
        shift = np.abs((found - colrow).mean(axis=0))
        assert (shift > 3).all() and (shift < 13).all()
