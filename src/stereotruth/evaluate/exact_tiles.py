"""Tiles of synthetic cities with exact labels, to train on as many as one likes.

No LiDAR is flown: the label of a pixel is the exact disparity of what it shows, where both images
show it. Images, RPCs and epipolar geometry are those of the pipeline, with control points without
noise; the layout is that of the published WHU-Stereo.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from stereocities.cities import TILES_A_CITY, CitySpec, training_city
from stereocities.control_points import simulate_points
from stereocities.render import simulate_image

from ..align.adjustment import epipolar_model
from ..align.align import align
from ..core.errors import InputError
from ..core.products.files import atomic_folder, link
from ..core.products.grids import require_complete
from ..core.products.rasters import write_tiff
from ..epipolar.model import EpipolarModel
from ..epipolar.rectify import rectify
from ..sensor.images import open_pair
from ..tiles.manifest import SPLITS
from .epipolar_truth import truth_window

NODATA = -999.0
STEP = 1024  # labels are rounded to parts of a px, as those of tiles are
MARGIN = 0.13, 160  # of the images beyond the tiles: share, px
FOLDERS = ("left", "right", "disp")


def make_city(number: int, folder: str | Path, *, size: int, seed: int, workers: int = 1) -> None:
    """The tiles (``size`` px squared) of a training city, in ``left``, ``right``, ``disp``.

    The folder appears whole. The right image of each tile is moved by a whole number of px, the
    mean disparity, so that disparities lie around 0.
    """
    side = round(2 * size * (1 + MARGIN[0])) + MARGIN[1]
    city = training_city(number, seed, side)
    with (
        tempfile.TemporaryDirectory(prefix="stereotruth-") as scratch,
        atomic_folder(folder) as out,
    ):
        model, images = _rectified(city, Path(scratch), seed, workers)
        row, col = ((n - 2 * size) // 2 for n in model.shape)
        if row < 0 or col < 0:
            raise InputError(
                f"an epipolar grid of {model.shape[0]} x {model.shape[1]} px",
                remedy=f"make tiles smaller than {size} px",
            )
        for kind in FOLDERS:
            (out / kind).mkdir()
        for tile in range(TILES_A_CITY):
            first = row + tile // 2 * size, col + tile % 2 * size
            _write_tile(out, city, model, images, first, size, tile + 1)


def _rectified(
    city: CitySpec, scratch: Path, seed: int, workers: int
) -> tuple[EpipolarModel, dict[str, np.ndarray]]:
    """The epipolar model of a city's images, and the images on its grid."""
    (scene,) = city.scenes
    exact = scratch / "exact.csv"
    simulate_points(city, scene, scratch / "gcps.csv", exact, scratch / "check.csv", seed=seed)
    files = [scratch / f"{view}.tif" for view in ("left", "right")]
    for file in files:
        simulate_image(city, scene, file.stem, file, seed=seed)
    model = epipolar_model(align(*files, exact))
    stores = [scratch / f"{file.stem}.zarr" for file in files]
    with open_pair(*files) as pair:
        rectify(*pair, model, None, *stores, workers=workers)
    return model, {store.stem: require_complete(store)["image"][:] for store in stores}


def _write_tile(
    out: Path,
    city: CitySpec,
    model: EpipolarModel,
    images: Mapping[str, np.ndarray],
    first: tuple[int, int],
    size: int,
    number: int,
) -> None:
    rows, cols = (slice(n, n + size) for n in first)
    truth = truth_window(model, city, city.scenes[0], rows, cols)
    left = images["left"][rows, cols]
    seen = (truth["visible"] == 1) & (left > 0)
    disparity = np.where(seen, truth["disparity"], np.nan)
    offset = round(float(np.nanmean(disparity))) if seen.any() else 0
    labels = np.rint((disparity - offset) * STEP) / STEP
    right = np.zeros_like(left)
    low, high = cols.start - offset, cols.stop - offset
    inside = slice(max(low, 0), min(high, images["right"].shape[1]))
    if inside.start < inside.stop:
        right[:, inside.start - low : inside.stop - low] = images["right"][rows, inside]
    of = city.name.replace("-", "")
    write_tiff(out / "left" / f"{of}_left_{number}.tiff", left, nodata=0)
    write_tiff(out / "right" / f"{of}_right_{number}.tiff", right, nodata=0)
    disp = np.where(np.isfinite(labels), labels, NODATA).astype(np.float32)
    write_tiff(out / "disp" / f"{of}_disparity_{number}.tiff", disp, nodata=NODATA)


def gather(
    training: Sequence[str | Path], validation: Sequence[str | Path], folder: str | Path, count: int
) -> None:
    """The first ``count`` tiles of the training cities, and all of the others to validate by.

    Folders of :func:`make_city`; the new one has ``train`` and ``val``. Raises InputError if there
    are fewer.
    """
    lefts = [file for city in training for file in sorted(Path(city).glob("left/*.tiff"))]
    if len(lefts) < count:
        raise InputError(f"{len(lefts)} tiles instead of {count}", remedy="make more cities")
    others = [file for city in validation for file in sorted(Path(city).glob("left/*.tiff"))]
    with atomic_folder(folder) as out:
        for split, files in zip(SPLITS, (lefts[:count], others)):
            for left in files:
                for kind, word in zip(FOLDERS, ("left", "right", "disparity")):
                    name = left.name.replace("_left_", f"_{word}_")
                    link(left.parents[1] / kind / name, out / split / kind / name)
