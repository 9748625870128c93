"""The RPCs that are shipped, and cameras of given ones, by GDAL's own code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

from stereocities.camera import locate, project
from stereocities.layout import frame_of
from stereocities.render import prepare
from stereocities.rpcs import NUMBERS, RATIOS, read_rpc, rpc_camera
from stereocities.truth import truth_at
from stereocities.twin_world import twin_city
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import open_raster

from ...synthetic import house_points as place
from ...synthetic.small_cities import ONE_BOX, TOWN

SIZE = 420, 400


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    """RPCs of both images of another city, as texts."""
    ready = prepare(ONE_BOX, ONE_BOX.scenes[0])
    folder = tmp_path_factory.mktemp("rpcs")
    files = []
    for camera in (ready.left, ready.right):
        numbers = zip(NUMBERS, map(float, camera.rpc.numbers))
        lines = [f"{name.upper()}: {value!r}" for name, value in numbers]
        for name, ratio in zip(RATIOS, camera.rpc.coefficients):
            lines += [
                f"{name.upper()}_{k}: {value!r}" for k, value in enumerate(map(float, ratio), 1)
            ]
        files.append(folder / f"{camera.name}_RPC.TXT")
        files[-1].write_text("\n".join(lines) + "\n")
    return tuple(files)


def by_gdal(rpc, lonlath):
    with RPCTransformer(rpc.metadata) as transformer:
        rows, cols = transformer.rowcol(*lonlath[:, :2].T, zs=lonlath[:, 2], op=lambda v: v)
    return np.column_stack([cols, rows]) - 0.5  # GDAL's pixels begin at their corner


def test_a_camera_sees_as_its_rpcs_do(texts):
    frame = frame_of(ONE_BOX)
    rpc = read_rpc(texts[1])
    heights = frame.height - 20.0, frame.height + 120.0
    cam = rpc_camera(rpc, frame, SIZE, heights)
    rng = np.random.default_rng(1)
    image = rng.uniform(0, SIZE, (300, 2))
    xyz = locate(cam, frame, image, rng.uniform(*heights, 300))
    np.testing.assert_allclose(project(cam, xyz), image, atol=1e-6)
    np.testing.assert_allclose(by_gdal(rpc, frame.to_geodetic(xyz)), image, atol=5e-3)


@pytest.mark.slow
def test_a_twin_by_given_rpcs_shows_its_place(texts, tmp_path):
    file = place.write_place(tmp_path / "house.laz")
    city = twin_city("House", file, rpcs=texts)
    (scene,) = city.scenes
    ready = prepare(city, scene)
    assert ready.left.rpc.rms_px < 0.01 and np.abs(ready.left.rpc.bias[:, 2]).max() > 1
    middle = np.array(
        [[(camera.cols - 1) / 2, (camera.rows - 1) / 2] for camera in (ready.left, ready.right)]
    )
    for view, at in zip(("left", "right"), middle):
        truth = truth_at(city, scene, at[:1], at[1:], view)
        xyz = ready.frame.from_geodetic(np.array([[truth[k][0] for k in ("lon", "lat", "height")]]))
        assert np.abs(xyz[0, :2]).max() < 12.0
        assert truth["visible_right"] == 1


def test_a_file_without_rpcs_is_refused(tmp_path):
    (tmp_path / "none.txt").write_text("LINE_OFF: 3\n")
    with pytest.raises(InputError):
        read_rpc(tmp_path / "none.txt")
    image = tmp_path / "image.tif"
    with open_raster(image, "w", driver="GTiff", width=4, height=4, count=1, dtype="uint8") as out:
        out.write(np.zeros((1, 4, 4), np.uint8))
    with pytest.raises(InputError):
        read_rpc(image)
    with pytest.raises(InputError):
        read_rpc(tmp_path / "away.tif")


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
