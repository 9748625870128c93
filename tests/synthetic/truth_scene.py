"""A scene with a roof and its exact truth, from linear RPCs."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import zarr

from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rpc import SensorModel
from stereotruth.products import grids

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
    with grids.building(path) as scratch:
        group = zarr.open_group(scratch, mode="w", zarr_format=3)
        group.attrs.update(attrs)
        for name, values in layers.items():
            group.create_array(name, data=values, chunks=(100, 100), dimension_names=("y", "x"))
    return path


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
    with grids.building(path) as scratch:
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
