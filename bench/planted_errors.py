"""Errors planted in a real scene: what align and refine take out, find, and cannot tell.

Alignment: the RPCs of a pair are moved by a known affine, control points are drawn and measured
anew with noise, and a random part of the tie points is withheld; what is left after `align` and
`refine` is compared with the check points and with the stated uncertainty.
Datum: the LiDAR is written with a fault of its heights or coordinates and goes through `ingest`,
`align` and `refine`. See README.md beside this file.

python bench/planted_errors.py --scene ../shared/real/marseille
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import laspy
import numpy as np
import pyproj
from accuracy import print_table
from numpy.typing import NDArray

from stereotruth.alignment import refine as refinement
from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import align, from_rpcs
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.control_points import COLUMNS, ControlPoints, read_gcps
from stereotruth.alignment.label_uncertainty import label_sigma
from stereotruth.alignment.refine import refine
from stereotruth.alignment.robust_fit import System
from stereotruth.alignment.tie_points import Geometry, match
from stereotruth.alignment.tie_sites import SITE, Site, choose_sites, find_places
from stereotruth.epipolar.image_reader import open_pair
from stereotruth.epipolar.rpc import SensorModel
from stereotruth.epipolar.rpc_files import read_rpc
from stereotruth.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.products.ungeoreferenced import open_raster

Floats = NDArray[np.float64]
VIEWS = ("left", "right")
MEASURED_PX = 0.25  # noise of a control point's image coordinates
KINDS = ("left col", "left row", "right col", "right row", "both shifted", "tilt", "affine")
SIZES_PX = (0.2, 0.5, 1.0, 2.0, 5.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A pair with what is known of it; ``true`` the sensor models that its check points ask for."""

    images: tuple[Path, Path]
    sizes: tuple[tuple[int, int], tuple[int, int]]
    gcps: ControlPoints
    lidar: tuple[Path, ...]
    true: tuple[SensorModel, SensorModel]
    ground: Floats  # lon, lat, height [3, n] of check points


def opened(folder: Path) -> Scene:
    """The scene of a folder: left.tif, right.tif, gcps.csv, checkpoints.csv, lidar/."""
    images = folder / "left.tif", folder / "right.tif"
    checks = read_gcps(folder / "checkpoints.csv")
    ground = np.stack([checks.lon, checks.lat, checks.height])
    true, sizes = [], []
    for image, measured in zip(images, (checks.left, checks.right)):
        rpc = read_rpc(image)
        seen = np.isfinite(measured[:, 0])
        predicted = np.stack(SensorModel(rpc).project(*ground[:, seen]), axis=1)
        system = System.of("affine", predicted, measured[seen])
        everything = np.ones(int(seen.sum()), bool)
        true.append(SensorModel(rpc, system.affine(system.solve(everything))))
        with open_raster(image) as dataset:
            sizes.append((dataset.width, dataset.height))
    lidar = tuple(sorted(p for p in (folder / "lidar").iterdir() if p.suffix in (".las", ".laz")))
    few = ground[:, :: max(1, ground.shape[1] // 400)]
    return Scene(images, tuple(sizes), read_gcps(folder / "gcps.csv"), lidar, tuple(true), few)


# ------------------------------------------------------------------------------- alignment errors


def planted_affines(
    kind: str, size_px: float, sizes: Any, rng: np.random.Generator
) -> list[Floats]:
    """Affines [2, 3] of both images; tilts are ``size_px`` at the frame's edge."""
    affines = []
    for view, (cols, rows) in zip(VIEWS, sizes):
        linear, shift = np.zeros((2, 2)), np.zeros(2)
        half = max(cols, rows) / 2
        if kind.startswith(view):
            shift[("col", "row").index(kind.split()[1])] = rng.choice([-1, 1]) * size_px
        elif kind in ("both shifted", "affine"):
            shift = rng.choice([-1, 1], 2) * size_px
        if kind in ("tilt", "affine"):
            linear = rng.choice([-1, 1], (2, 2)) * size_px / half
        middle = np.array([(cols - 1) / 2, (rows - 1) / 2])
        affines.append(np.column_stack([np.eye(2) + linear, shift - linear @ middle]))
    return affines


def write_moved(scene: Scene, affines: Sequence[Floats], folder: Path) -> list[Path]:
    """The images with RPCs that are off by an affine."""
    files = []
    for image, affine in zip(scene.images, affines):
        rpc, miss = SensorModel(read_rpc(image), affine).corrected_rpc()
        assert miss < 0.02, f"the RPC cannot be moved so ({miss:.3f} px)"
        tags = {
            name.upper(): " ".join(repr(float(v)) for v in np.atleast_1d(value))
            for name, value in rpc.to_dict().items()
        }
        file = folder / image.name
        with open_raster(image) as source:
            pixels, profile = source.read(), source.profile
        profile.pop("compress", None)
        with open_raster(file, "w", **profile) as target:
            target.write(pixels)
            target.update_tags(ns="RPC", ERR_BIAS="-1", ERR_RAND="-1", **tags)
        files.append(file)
    return files


def write_gcps(
    scene: Scene, count: int, noise_px: float, file: Path, rng: np.random.Generator
) -> None:
    """A random part of the control points, where the true sensors see them, measured anew."""
    points = scene.gcps
    chosen = np.sort(rng.permutation(len(points.ids))[:count])
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for i in chosen:
            ground = points.lon[i], points.lat[i], points.height[i]
            row = [points.ids[i], *(repr(float(v)) for v in ground)]
            for sensor in scene.true:
                row += [repr(float(v) + noise_px * rng.normal()) for v in sensor.project(*ground)]
            writer.writerow(row)


def withholding(share: float, seed: int) -> Callable[..., list[Site]]:
    """`choose_sites` without a random part of the sites, the same wherever it is asked."""
    field = np.random.default_rng([seed, 1]).uniform(size=(512, 512))

    def kept(*arguments: Any) -> list[Site]:
        return [s for s in choose_sites(*arguments) if not withheld(s)]

    def withheld(site: Site) -> bool:
        return bool(field[int(site[1] + SITE) // SITE, int(site[0] + SITE) // SITE] < share)

    kept.withheld = withheld
    return kept


def errors_left(alignment: Alignment, scene: Scene) -> dict[str, Floats]:
    """Errors [n] px at the check points' ground, and their stated standard uncertainties.

    disparity and y-parallax of true correspondences, and the place (x, y) of labels.
    """
    model = epipolar_model(alignment)
    left, right = (sensor.project(*scene.ground) for sensor in scene.true)
    x_left, y_left = model.left_to_epipolar(*left)
    x_right, y_right = model.right_to_epipolar(*right)
    label = model.ground_to_epipolar(*scene.ground)
    sigma, sigma_x, sigma_y = label_sigma(alignment, model, x_left, y_left)
    effects = [
        image.slopes(*at)[:, 1][:, None, :] @ fit.design(*at)
        for image, at, fit in zip(
            (model.left_image, model.right_image), (left, right), alignment.fits
        )
    ]
    across = np.concatenate([effects[0][:, 0], -effects[1][:, 0]], axis=-1)
    variance = np.einsum("ni,ij,nj->n", across, alignment.covariance, across)
    return {
        "disparity": label[0] - label[2] - (x_left - x_right),
        "y_parallax": y_right - y_left,
        "x": label[0] - x_left,
        "y": label[1] - y_left,
        "sigma_disparity": sigma,
        "sigma_y_parallax": np.sqrt(np.maximum(variance, 0.0)),
        "sigma_x": sigma_x,
        "sigma_y": sigma_y,
    }


def at_withheld(
    alignment: Alignment, images: Sequence[Path], sizes: Any, stores: Sequence[Path], withheld: Any
) -> dict[str, float]:
    """Medians px of disparity and y-parallax at tie points that took no part."""
    model = epipolar_model(alignment)
    opened_stores = [PointStore(path) for path in stores]
    with open_pair(*images) as sources:
        sites = choose_sites(alignment.left, alignment.right, sizes, opened_stores)
        sites = [site for site in sites if withheld(site)]
        places = find_places(alignment.left, alignment.right, sources[0], opened_stores, sites)
        ties = match(places, Geometry.of(places, alignment.left, alignment.right), sources, 6)
    if not len(ties):
        return {"ties": 0}
    slopes = model.right_image.slopes(ties.right[:, 0], ties.right[:, 1])
    seen = np.einsum("nab,nb->na", slopes, ties.shift)
    along, across = np.median(seen, axis=0)
    return {"ties": len(ties), "along": float(along), "across": float(across)}


def alignment_trial(
    scene: Scene, stores: Sequence[Path], seed: int, with_gcps: bool, noise_px: float
) -> dict[str, Any]:
    """One planted error and what is left of it."""
    rng = np.random.default_rng([seed, int(with_gcps)])
    kind, size_px = KINDS[seed % len(KINDS)], SIZES_PX[seed // len(KINDS) % len(SIZES_PX)]
    count = int(rng.integers(5, len(scene.gcps.ids) + 1))
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        affines = planted_affines(kind, size_px, scene.sizes, rng)
        images = write_moved(scene, affines, folder)
        kept = withholding(1 / 3, seed)
        record: dict[str, Any] = {"kind": kind, "size_px": size_px}
        try:
            if with_gcps:
                write_gcps(scene, count, noise_px, folder / "gcps.csv", rng)
                start = align(*images, folder / "gcps.csv", seed=seed, provenance={})
                record["gcps"] = count
            else:
                start = from_rpcs(*images, provenance={})
            with mock.patch.object(refinement, "choose_sites", kept):
                refined, _ = refine(start, *images, stores)
        except InputError as error:
            return record | {"refused": str(error)}
        record["applied"] = bool(refined.refinement["applied"])
        record["reason"] = refined.refinement["reason"]
        record["warnings"] = list(refined.warnings)
        for state, alignment in (("start", start), ("left", refined)):
            left = errors_left(alignment, scene)
            for name in ("disparity", "y_parallax", "x", "y"):
                error, sigma = left[name], left[f"sigma_{name}"]
                record[f"{state} {name}"] = {
                    "rms": float(np.sqrt(np.nanmean(error**2))),
                    "sigma": float(np.nanmean(sigma)),
                    "mean": float(np.nanmean(error)),
                    "within": float(np.nanmean(np.abs(error) < sigma)),
                    "within_2": float(np.nanmean(np.abs(error) < 2 * sigma)),
                }
        record["withheld"] = at_withheld(refined, images, scene.sizes, stores, kept.withheld)
    return record
