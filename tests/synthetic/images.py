"""What tests make by hand: images with known content."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from stereotruth.sensor.rpc import RPC

from .cameras import to_rasterio


def write_image(path: Path, rpc: RPC | None, pixels: np.ndarray | None = None, **options) -> Path:
    pixels = np.full((8, 8), 7, dtype=np.uint16) if pixels is None else pixels
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=pixels.shape[-1],
            height=pixels.shape[-2],
            count=len(pixels) if pixels.ndim == 3 else 1,
            dtype=pixels.dtype,
            **options,
        ) as dataset:
            dataset.write(np.atleast_3d(pixels.T).T)
            if rpc is not None:
                dataset.rpcs = to_rasterio(rpc)
    return path


def pattern(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """A smooth texture on the ground (waves of 5 to 40 m), digital numbers near 1000."""
    rng = np.random.default_rng(5)
    value = np.full(np.shape(east), 1000.0)
    for length in (5.0, 6.0, 8.0, 11.0, 17.0, 40.0):
        angle, phase = rng.uniform(0, np.pi, 2)
        wave = np.cos(angle) * east + np.sin(angle) * north
        value += 80.0 * np.sin(2 * np.pi / length * wave + phase)
    return value


def write(path: Path, array, nodata=None, **options) -> Path:
    array = np.atleast_3d(np.asarray(array)).transpose(2, 0, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {"dtype": array.dtype.name, "count": len(array), "nodata": nodata, **options}
    with rasterio.open(
        path, "w", driver="GTiff", height=array.shape[1], width=array.shape[2], **profile
    ) as target:
        target.write(array)
    return path


# ---------------------------------------------------------------- on textured images, with SGM


def textured(disparity, seed=0):
    """uint16 images of a smooth disparity, by a random sum of waves that is known everywhere."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: disparity.shape[0], : disparity.shape[1]].astype(float)
    waves = rng.normal(0, 0.35, (2, 80))
    phases = rng.uniform(0, 6.28, 80)

    def paint(column):
        grey = np.zeros(column.shape)
        for (a, b), phase in zip(waves.T, phases):
            grey += np.sin(a * column + b * y + phase)
        return (1000 + 40 * grey).astype(np.uint16)

    return paint(x - disparity), paint(x)
