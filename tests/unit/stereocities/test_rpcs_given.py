"""Cameras of given RPCs: they see as GDAL says that the RPCs do, and rays lead back."""

from __future__ import annotations

import numpy as np
import pytest
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer

from stereocities.camera import LocalFrame, jittering, locate, project
from stereocities.cities import Jitter
from stereocities.layout import frame_of
from stereocities.render import prepare
from stereocities.rpcs import NAMES, RATIOS, read_rpc, rpc_camera
from stereocities.truth import truth_at
from stereocities.twin_world import twin_city
from stereotruth.core.errors import InputError
from stereotruth.core.products.ungeoreferenced import open_raster

from ...synthetic import house_points as place
from ...synthetic.small_cities import ONE_BOX

SIZE = 420, 400


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    """RPCs of both images of another city, as texts."""
    ready = prepare(ONE_BOX, ONE_BOX.scenes[0])
    folder = tmp_path_factory.mktemp("rpcs")
    files = []
    for camera in (ready.left, ready.right):
        lines = [f"{name}: {value!r}" for name, value in zip(NAMES, map(float, camera.rpc.numbers))]
        for name, ratio in zip(RATIOS, camera.rpc.coefficients):
            lines += [f"{name}_{k}: {value!r}" for k, value in enumerate(map(float, ratio), 1)]
        files.append(folder / f"{camera.name}_RPC.TXT")
        files[-1].write_text("\n".join(lines) + "\n")
    return tuple(files)


def by_gdal(rpc, lonlath):
    line_off, samp_off, lat_off, lon_off, h_off, line_s, samp_s, lat_s, lon_s, h_s = map(
        float, rpc.numbers
    )
    line_num, line_den, samp_num, samp_den = (c.tolist() for c in rpc.coefficients)
    with RPCTransformer(RPC(
        height_off=h_off, height_scale=h_s, lat_off=lat_off, lat_scale=lat_s,
        line_den_coeff=line_den, line_num_coeff=line_num, line_off=line_off, line_scale=line_s,
        long_off=lon_off, long_scale=lon_s, samp_den_coeff=samp_den, samp_num_coeff=samp_num,
        samp_off=samp_off, samp_scale=samp_s,
    )) as transformer:  # fmt: skip
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


def test_a_camera_by_rpcs_jitters(texts):
    """By as many px rms as it is told, along and across; and points are found again."""
    frame = frame_of(ONE_BOX)
    heights = frame.height - 20.0, frame.height + 120.0
    cam = rpc_camera(read_rpc(texts[1]), frame, SIZE, heights)
    shaken = jittering(cam, Jitter(0.2), np.random.default_rng(3))
    rows = np.arange(SIZE[1], dtype=float)
    image = np.column_stack([np.full(len(rows), 200.0), rows])
    xyz = locate(shaken, frame, image, np.full(len(rows), frame.height))
    np.testing.assert_allclose(project(shaken, xyz), image, atol=1e-6)
    moved = project(cam, xyz) - image
    np.testing.assert_allclose(moved.std(axis=0), 0.2, rtol=0.25)


def test_rpcs_are_moved_over_another_place(texts):
    """A pixel has the size there that it has at home."""
    rpc = read_rpc(texts[0])
    moved = rpc.over(4.36, 43.8, 60.0)
    assert rpc.over(ONE_BOX.lon, ONE_BOX.lat, ONE_BOX.base_height_m) is rpc
    sizes = []
    for of, at in (
        (rpc, (ONE_BOX.lon, ONE_BOX.lat, ONE_BOX.base_height_m)),
        (moved, (4.36, 43.8, 60.0)),
    ):
        frame = LocalFrame(*at)
        cam = rpc_camera(of, frame, SIZE, (at[2] - 50, at[2] + 100))
        xyz = locate(
            cam, frame, np.array([[200.0, 200], [201, 200], [200, 201]]), np.full(3, at[2])
        )
        sizes.append(np.hypot(*(xyz[1:] - xyz[0])[:, :2].T))
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=5e-3)


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
    with pytest.raises(InputError, match=r"none\.txt.*has no RPCs"):
        read_rpc(tmp_path / "none.txt")
    image = tmp_path / "image.tif"
    with open_raster(image, "w", driver="GTiff", width=4, height=4, count=1, dtype="uint8") as out:
        out.write(np.zeros((1, 4, 4), np.uint8))
    with pytest.raises(InputError, match=r"image\.tif.*has no RPCs"):
        read_rpc(image)
    with pytest.raises(InputError, match="no such file"):
        read_rpc(tmp_path / "away.tif")
