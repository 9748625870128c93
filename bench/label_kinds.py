"""Training scenes with several kinds of labels, and unseen scenes with their exact truth.

A training scene is drawn, imaged, flown by LiDAR of 4 and of 1 points/m², aligned by control points
of 0.25 px noise and refined, as the workflow does it. Kinds of labels:

``exact``: the simulator's truth of the pixels that both images show. ``ours-4``, ``ours-1``: the
pipeline's, by density. ``ours-4-weighted``: the same labels with their uncertainties. ``raster``:
the recipe of datasets that begin with a raster DSM, see :func:`raster_labels`.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray
from rasterio.fill import fillnodata
from scipy.ndimage import distance_transform_edt
from synthetic_pairs import label_by, rectify_by
from wooded_scenes import MIXED, Draw, Scene

from stereotruth.alignment.align import align
from stereotruth.alignment.refine import refine
from stereotruth.config.labels import LabelSettings
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluation.epipolar_truth import truth_window
from stereotruth.lidar.point_store import PointStore
from stereotruth.products.files import atomic_folder
from stereotruth.products.grids import open_grid, require_complete
from stereotruth.simulate.surfaces import TREE, WATER
from stereotruth.status import is_labelled

DENSITIES = (4.0, 1.0)  # points/m²
GCPS = 15
CELL_M = 0.5  # of the raster DSM
FINER = 4  # cells of the upsampled one to a side of a cell
FILL_CELLS = 100  # how far the DSM's holes are filled, as GDAL does it by default
KINDS = ("exact", "ours-4", "ours-1", "raster", "ours-4-weighted")
TRAINING_SEED, UNSEEN_SEED = 7100, 9100
LANDS = ("town", "suburb", "park")
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Labelled:
    """A pair [h, w] of grey values and its labels.

    ``disparity`` px, NaN unlabelled; ``sigma`` px, standard uncertainty of the labels, 0 where the
    kind tells none. ``offset`` px is taken from the disparity, and the right image is moved by it.
    """

    left: NDArray[np.uint16]
    right: NDArray[np.uint16]
    disparity: Floats
    sigma: Floats


@dataclass(frozen=True, eq=False)
class Unseen:
    """A pair [h, w] and what it shows; ``near``: within 3 px of a height step."""

    left: NDArray[np.uint16]
    right: NDArray[np.uint16]
    disparity: Floats
    parts: dict[str, Bools]


def draw(number: int, side_px: int, unseen: bool = False) -> Draw:
    """What scene ``number`` is drawn from: town, suburb and park in turns."""
    seed = (UNSEEN_SEED if unseen else TRAINING_SEED) + number
    rng = np.random.default_rng([seed, 32])
    return Draw(
        seed, zones=LANDS[number % 3], ground_m2=float(rng.uniform(90.0, 300.0)),
        arrangement="forest" if number % 3 == 2 else "single",
        brightness=float(rng.uniform(0.3, 0.5)), relief_m=float(rng.uniform(5.0, 30.0)),
        buildings=0.9, side_px=side_px, **MIXED,
    )  # fmt: skip


def training_pairs(number: int, side_px: int, folder: Path) -> dict[str, Labelled]:
    """The pair of a training scene with each kind of label; made once."""
    found: dict[str, Labelled] = {}
    for density in DENSITIES:
        scene = Scene(replace(draw(number, side_px), density=density), folder)
        made = folder / "labelled" / scene.draw.key()
        if not made.is_dir():
            with atomic_folder(made) as scratch:
                alone = scene.align(GCPS)
                refined, _ = refine(alone, *scene.images, scene.stores, provenance={})
                label_by(refined, scene.images, scene.stores, scratch, LabelSettings(), workers=2)
        model = EpipolarModel.load(made / "epipolar.json")
        images = _images(made)
        labels = open_grid(made / "disparity.zarr")
        ours = np.where(is_labelled(labels["status"].values), labels["disparity"].values, np.nan)
        sigma = np.where(np.isfinite(ours), labels["uncertainty"].values, 0).astype(np.float32)
        truth = _truth(scene, model, made)
        offset = round(float(np.nanmedian(truth["disparity"])))
        left, right = images[0], moved(images[1], offset)
        none = np.zeros_like(sigma)

        def pair(disparity: NDArray, sigma: Floats) -> Labelled:
            return Labelled(left, right, (disparity - offset).astype(np.float32), sigma)  # noqa: B023

        found[f"ours-{density:g}"] = pair(ours, none)
        if density == DENSITIES[0]:
            seen = (truth["visible"] == 1) & (left > 0)
            found["exact"] = pair(np.where(seen, truth["disparity"], np.nan), none)
            found["ours-4-weighted"] = pair(ours, sigma)
            cells = raster_dsm([PointStore(path) for path in scene.stores], scene.city.epsg)
            found["raster"] = pair(raster_labels(*cells, scene.city.epsg, model), none)
    return {kind: found[kind] for kind in KINDS}


def unseen_pair(number: int, side_px: int, folder: Path) -> Unseen:
    """A scene that no network was trained on, rectified by exact control points; made once."""
    scene = Scene(draw(number, side_px, unseen=True), folder)
    made = folder / "unseen" / scene.draw.key("density")
    if not made.is_dir():
        with atomic_folder(made) as scratch:
            scene.gcps(GCPS)
            exact = scene.images[0].parent / "exact.csv"
            rectify_by(align(*scene.images, exact, provenance={}), scene.images, scratch)
    truth = _truth(scene, EpipolarModel.load(made / "epipolar.json"), made)
    left, right = _images(made)
    offset = round(float(np.nanmedian(truth["disparity"])))
    shown = (left > 0) & (truth["surface"] != WATER) & np.isfinite(truth["disparity"])
    seen = shown & (truth["visible"] == 1)
    near = distance_transform_edt(truth["edge"] == 0) <= 3.0 if truth["edge"].any() else ~shown
    parts = {
        "visible": seen,
        "edges": seen & near,
        "crowns": seen & (truth["surface"] == TREE),
        "hidden": shown & (truth["hidden"] == 1),
    }
    disparity = (truth["disparity"] - offset).astype(np.float32)
    return Unseen(left, moved(right, offset), disparity, parts)


def moved(right: NDArray[np.uint16], offset: int) -> NDArray[np.uint16]:
    """The right image [h, w] moved by ``offset`` columns to the right, 0 where it has none."""
    out = np.zeros_like(right)
    cols = right.shape[1]
    low, high = max(offset, 0), min(cols, cols + offset)
    out[:, low:high] = right[:, low - offset : high - offset]
    return out


def _images(made: Path) -> list[NDArray[np.uint16]]:
    """Left and right on the left image's grid: the right one cut or widened to its size."""
    left, right = (require_complete(made / f"{v}.zarr")["image"][:] for v in ("left", "right"))
    same = np.zeros_like(left)
    rows, cols = np.minimum(left.shape, right.shape)
    same[:rows, :cols] = right[:rows, :cols]
    return [left, same]


def _truth(scene: Scene, model: EpipolarModel, made: Path) -> dict[str, NDArray]:
    """The layers of the exact truth on the whole left grid; kept beside its model."""
    kept = made.with_name(f"{made.name}-truth") / "truth.npz"
    if not kept.is_file():
        rows, cols = (slice(0, n) for n in model.shape)
        with atomic_folder(kept.parent) as scratch:
            layers = truth_window(model, scene.city, scene.spec, rows, cols)
            np.savez_compressed(scratch / kept.name, **layers)
    with np.load(kept) as layers:
        return dict(layers)


def raster_dsm(stores: Sequence[PointStore], epsg: int) -> tuple[Floats, float, float]:
    """A DSM of 0.5 m as rasters of LiDAR have it: the highest point of each cell, holes filled.

    Heights [rows, cols] (m), north up; the west and north edge of the grid (m in ``epsg``).
    """
    to_plan = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
    points = [store.query(*store.bounds[:4]) for store in stores]
    east, north = to_plan.transform(
        np.concatenate([p.lon for p in points]), np.concatenate([p.lat for p in points])
    )
    height = np.concatenate([p.height for p in points]).astype(np.float32)
    west, top = np.floor(east.min()), np.ceil(north.max())
    col, row = ((a / CELL_M).astype(np.int64) for a in (east - west, top - north))
    dsm = np.full((int(row.max()) + 1, int(col.max()) + 1), -np.inf, np.float32)
    np.maximum.at(dsm, (row, col), height)
    known = np.isfinite(dsm)
    dsm[~known] = 0
    return fillnodata(dsm, known.astype(np.uint8), FILL_CELLS), float(west), float(top)


def raster_labels(
    dsm: Floats, west: float, north: float, epsg: int, model: EpipolarModel
) -> NDArray[np.float64]:
    """Labels [h, w] (px) by the raster recipe; NaN where no cell falls.

    The DSM is upsampled four times (bilinear), each fine cell is projected into both images, and
    gives its disparity to the pixel of the left grid that is nearest. Of several the highest wins.
    Nothing asks whether the right view sees it.
    """
    from_plan = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True)
    rows, cols = model.shape
    highest = np.full(rows * cols, -np.inf)
    labels = np.full(rows * cols, np.nan)
    u = (np.arange(dsm.shape[1] * FINER) + 0.5) / FINER - 0.5  # in cells
    low_u = np.clip(np.floor(u).astype(int), 0, dsm.shape[1] - 2)
    share_u = np.clip(u - low_u, 0.0, 1.0)
    for fine in range(dsm.shape[0] * FINER):
        v = (fine + 0.5) / FINER - 0.5
        low_v = min(max(int(np.floor(v)), 0), dsm.shape[0] - 2)
        share_v = min(max(v - low_v, 0.0), 1.0)
        line = dsm[low_v] * (1 - share_v) + dsm[low_v + 1] * share_v
        height = line[low_u] * (1 - share_u) + line[low_u + 1] * share_u
        lon, lat = from_plan.transform(
            west + (u + 0.5) * CELL_M, np.full(u.size, north - (v + 0.5) * CELL_M)
        )
        x_left, y, x_right, _ = model.ground_to_epipolar(lon, lat, height)
        x, y = np.rint(np.nan_to_num([x_left, y], nan=-1.0)).astype(np.int64)
        inside = (x >= 0) & (x < cols) & (y >= 0) & (y < rows)
        at, height = (y * cols + x)[inside], height[inside]
        order = np.argsort(height, kind="stable")  # the highest is written last
        at, height = at[order], height[order]
        disparity = (x_left - x_right)[inside][order]
        wins = height > highest[at]
        at = at[wins]
        highest[at], labels[at] = height[wins], disparity[wins]
    return labels.reshape(rows, cols)


def digest_of(pairs: Sequence[Labelled]) -> str:
    """A checksum of what a network is trained on."""
    value = 0
    for pair in pairs:
        for array in (pair.left, pair.right, pair.disparity, pair.sigma):
            value = zlib.crc32(np.ascontiguousarray(array).view(np.uint8), value)
    return f"{value:08x}"
