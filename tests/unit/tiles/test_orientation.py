"""Sidecars of tiles lead back to the sensors and the ground."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import zarr

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.rpc import RPC
from stereotruth.tiles.orientation import PixelSize, evaluate, orientation, sensor_record
from stereotruth.tiles.scene_stores import SceneFiles

from ...synthetic import flat_orientation
from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, camera
from ...synthetic.tiled_scene import LAT, LON, SIZE, labels, rows_of, terrain

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_sidecar_leads_back_to_sensor_pixels_and_ground(
    exported: tuple[Path, dict], scene: SceneFiles
) -> None:
    folder, _ = exported
    model = EpipolarModel.from_dict(zarr.open_group(scene.disparity).attrs["epipolar"])
    for row in rows_of(folder)[::5]:
        record = json.loads((folder / row["orientation"]).read_text())
        row0, col0, offset = (int(row[k]) for k in ("row0", "col0", "right_offset_px"))
        rng = np.random.default_rng(int(row["number"]))
        x, y = rng.uniform(-0.5, SIZE - 0.5, (2, 200))
        truth = {
            "left": model.epipolar_to_left(x + col0, y + row0),
            "right": model.epipolar_to_right(x + col0 - offset, y + row0),
        }
        for view, (col, line) in truth.items():
            got = evaluate(record[view]["tile_to_sensor"], x, y)
            assert np.abs(got["col"] - col).max() <= 0.01
            assert np.abs(got["row"] - line).max() <= 0.01
            back = evaluate(record[view]["sensor_to_tile"], col, line)
            assert max(np.abs(back["x"] - x).max(), np.abs(back["y"] - y).max()) <= 0.01
            rpc = RPC.from_dict(record[view]["corrected_rpc"])
            sensor = model.left if view == "left" else model.right
            point = (LON + 1e-4, LAT - 2e-4, 45.0)
            assert np.allclose(rpc.project(*point), sensor.project(*point), atol=1e-3)
        lon, lat = model.epipolar_to_ground(x + col0, y + row0, 44.0)
        xl, _, xr, _ = model.ground_to_epipolar(lon, lat, np.full(200, 44.0))
        ground = evaluate(record["ground"], x, y, xl - xr - offset)
        assert np.abs(ground["height"] - 44.0).max() < 0.01
        assert np.abs(ground["lon"] - lon).max() < 1e-8 and np.abs(ground["lat"] - lat).max() < 1e-8
        ring = np.array(record["footprint"]["coordinates"][0])
        assert np.array_equal(ring[0], ring[-1])
        corner = model.epipolar_to_ground(
            col0 - 0.5, row0 - 0.5, record["footprint"]["heights_m"][0]
        )
        assert np.allclose(ring[0], corner, atol=1e-7)


def test_height_from_stored_disparity(exported: tuple[Path, dict]) -> None:
    """From files and the polynomial alone: the terrain, within the rounding of its values."""
    folder, _ = exported
    row = rows_of(folder)[0]
    record = json.loads((folder / row["orientation"]).read_text())
    disparity = labels(folder / row["disp"])
    y, x = np.nonzero(np.isfinite(disparity))
    got = evaluate(record["ground"], x, y, disparity[y, x])
    error = got["height"] - terrain(got["lon"], got["lat"])
    assert np.abs(error).max() < 0.03


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        (BACKWARD, FORWARD, "left: reference, the backward view"),
        (FORWARD, BACKWARD, "left: reference, the forward view"),
        ((0.3, 0.0), (-0.3, 0.0), "across the flight direction"),
    ],
)
def test_sidecar_says_which_view_looks_backward(left, right, said: str) -> None:
    size = 300, 280
    model = fit_epipolar(*(camera(look, size=size) for look in (left, right)), size, size, HEIGHT)
    record = orientation(
        model,
        {"left": sensor_record(model.left), "right": sensor_record(model.right)},
        row0=50,
        col0=60,
        size=SIZE,
        offset=0,
        height=np.full((SIZE, SIZE), HEIGHT),
        disparity=np.full((SIZE, SIZE), np.nan),
    )
    assert said in record["conventions"]["views"]


# ------------------------------------------------------------------ metres of a pixel


def test_a_pixel_has_the_metres_of_its_geometry():
    size = PixelSize.of(flat_orientation.orientation())
    assert size.ground_m == pytest.approx(flat_orientation.GSD, rel=1e-4)
    assert size.height_m == pytest.approx(flat_orientation.GSD / flat_orientation.RATIO, rel=1e-6)
    assert size.base_to_height == pytest.approx(flat_orientation.RATIO, rel=1e-4)


def test_the_mean_is_that_of_the_files_that_are_there(tmp_path):
    for name, gsd in (("a", 0.5), ("b", 1.5)):
        (tmp_path / f"{name}.json").write_text(json.dumps(flat_orientation.orientation(gsd)))
    size = PixelSize.mean(tmp_path / f"{name}.json" for name in "abc")
    assert size.ground_m == pytest.approx(1.0, rel=1e-4)
    assert size.height_m == pytest.approx(1.0 / flat_orientation.RATIO, rel=1e-6)
    assert PixelSize.mean([tmp_path / "c.json"]) is None
