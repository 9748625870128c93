"""A scene with a roof and its exact truth, from linear RPCs."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import zarr

from stereotruth.core.products import grids
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.rpc import SensorModel

from .surveyed_pair import linear_rpc

SIZE = {"left": (420, 380), "right": (380, 420)}
ROOF = (slice(150, 230), slice(180, 290))  # raw rows, cols
GROUND, ROOF_CLASS, WATER = 1, 2, 5
STATUSES = "no_points labelled hidden_in_left hidden_in_right"


class Scene(NamedTuple):
    model: EpipolarModel
    truth: Path
    raw_truth: Path
    folder: Path


def sensor(view: str, shift: tuple[float, float] = (0.0, 0.0)) -> SensorModel:
    gsd, angle = {"left": (0.65, -5.0), "right": (0.80, 26.0)}[view]
    affine = np.column_stack([np.eye(2), shift])
    return SensorModel(linear_rpc(gsd, angle, SIZE[view]), affine)


def surface_height(col, row):
    """Height in m as a function of the raw left position: a slope with a roof on it."""
    return 60.0 + 0.05 * col - 0.03 * row + 0.0001 * row * col


def on_roof(col, row):
    r, c = ROOF
    return (
        (row >= r.start - 0.5)
        & (row < r.stop - 0.5)
        & (col >= c.start - 0.5)
        & (col < c.stop - 0.5)
    )


def ground_at(left: SensorModel, col, row):
    height = surface_height(col, row) + np.where(on_roof(col, row), 20.0, 0.0)
    return (*left.localize(col, row, height), height)


def write_store(path: Path, layers: dict[str, np.ndarray], **attrs) -> Path:
    with grids.atomic_store(path) as scratch:
        group = zarr.open_group(scratch, mode="w", zarr_format=3)
        group.attrs.update(attrs)
        for name, values in layers.items():
            group.create_array(name, data=values, chunks=(100, 100), dimension_names=("y", "x"))
    return path


def make_scene(folder: Path) -> Scene:
    """The scene with its exact truth, in a folder."""
    left, right = sensor("left"), sensor("right")
    model = fit_epipolar(left, right, SIZE["left"], SIZE["right"], 65.0)
    row, col = np.mgrid[0:380, 0:420].astype(float)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    visible = (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210)
    raw = {"lon": lon, "lat": lat, "height": height, "right_col": right_col}
    raw |= {"right_row": right_row, "visible_right": visible.astype("uint8")}
    write_store(folder / "raw.zarr", raw)

    y, x = np.mgrid[0 : model.shape[0], 0 : model.shape[1]].astype(float)
    col, row = model.epipolar_to_left(x, y)
    shown = (np.abs(col - 209.5) <= 210) & (np.abs(row - 189.5) <= 190)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    right_x, right_y = model.right_to_epipolar(right_col, right_row)
    surface = np.where(on_roof(col, row), ROOF_CLASS, GROUND)
    surface[300:330, 60:120] = WATER
    surface[~shown] = 0
    behind = np.zeros(shown.shape, bool)
    behind[230:250, 180:290] = True
    inside = (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210)
    changed, edge, covered = (np.zeros(shown.shape, "uint8") for _ in range(3))
    changed[60:90, 60:90], changed[60:90, 100:120] = 1, 2
    edge[140:160], edge[100:110] = 1, 2
    covered[:, :340] = 1
    changed_right = np.zeros(shown.shape, "uint8")
    changed_right[200:260, 200:240] = 1
    layers = {
        "disparity": np.where(shown, x - right_x, np.nan).astype("float32"),
        "y_parallax": np.where(shown, right_y - y, np.nan).astype("float32"),
        "visible": (shown & inside & ~behind).astype("uint8"),
        "hidden": (shown & inside & behind).astype("uint8"),
        "changed": np.where(shown, changed, 0).astype("uint8"),
        "changed_right": np.where(shown & (changed == 0), changed_right, 0).astype("uint8"),
        "covered": np.where(shown, covered, 0).astype("uint8"),
        "surface": surface.astype("uint8"),
        "edge": edge,
    }
    write_store(folder / "truth.zarr", layers, kind="truth", epipolar=model.to_dict())
    return Scene(model, folder / "truth.zarr", folder / "raw.zarr", folder)


def perfect_labels(scene: Scene, model: EpipolarModel | None = None) -> np.ndarray:
    """The disparity at every epipolar pixel's centre, by the analytic surface."""
    model = model or scene.model
    y, x = np.mgrid[0 : model.shape[0], 0 : model.shape[1]].astype(float)
    col, row = scene.model.epipolar_to_left(x, y)
    lon, lat, height = ground_at(scene.model.left, col, row)
    found = model.ground_to_epipolar(lon, lat, height)
    labels = (found[0] - found[2]).reshape(x.shape)
    labels[(col < -0.5) | (col > 419.5) | (row < -0.5) | (row > 379.5)] = np.nan
    return labels


def write_disparity(
    scene: Scene, path: Path, labels: np.ndarray, sigma: float = 0.1, lost: int = 0
) -> Path:
    """A disparity store; pixels without a label have the status ``lost``."""
    status = np.where(np.isfinite(labels), 1, lost)
    layers = {
        "disparity": ("float32", np.nan, labels),
        "uncertainty": ("float32", np.nan, np.where(np.isfinite(labels), sigma, np.nan)),
        "status": ("uint8", 0, status),
    }
    attrs = {"units": "px", "long_name": "see the name"}
    flags = {"flag_values": [0, 1, 2, 3], "flag_meanings": STATUSES}
    with grids.atomic_store(path) as scratch:
        arrays = grids.create_grid(
            scratch,
            scene.model.shape,
            {n: grids.Layer(d, f, attrs | flags) for n, (d, f, _) in layers.items()},
            chunk=128,
            shard=256,
            attrs={"epipolar": scene.model.to_dict()},
        )
        for name, (dtype, _, values) in layers.items():
            arrays[name][:] = values.astype(dtype)
    return path
