"""A dataset of four small pairs of known disparity, in the layout of WHU-Stereo."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from stereotruth.tiles.stereo_dataset import StereoDataset

SIZE, RANGE = 64, (-16, 16)


def random_pair(rng: np.random.Generator, disparity: int) -> tuple[np.ndarray, np.ndarray]:
    """Random pixels, and the same moved along the rows so that all have the disparity."""
    wide = rng.integers(1, 2000, (SIZE, SIZE + 64)).astype(np.uint16)
    return wide[:, 32 : 32 + SIZE], wide[:, 32 + disparity : 32 + disparity + SIZE]


def write(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {"driver": "GTiff", "height": SIZE, "width": SIZE, "count": 1, "dtype": values.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile) as file:
            file.write(values, 1)


def small_dataset(root: Path) -> StereoDataset:
    """Three training pairs and one to validate on; a quarter of each is unlabelled."""
    rng = np.random.default_rng(5)
    for number, d in enumerate((-6, 3, 9, 5)):
        left, right = random_pair(rng, d)
        labels = np.full((SIZE, SIZE), d, np.float32)
        labels[: SIZE // 4] = -999
        folder = root / ("val" if number == 3 else "train")
        write(folder / "left" / f"QC_left_{number}.tiff", left)
        write(folder / "right" / f"QC_right_{number}.tiff", right)
        write(folder / "disp" / f"QC_disparity_{number}.tiff", labels)
    return StereoDataset("small", root, "whu", RANGE)
