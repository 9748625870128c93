"""Errors planted in a real scene: what align and refine take out, find, and cannot tell.

Alignment: the RPCs of a pair are moved by a known affine, control points are drawn and measured
anew with noise, and 60 % of the scene is withheld from the tie points; what is left after
`align` and `refine` is compared with the check points and with the stated uncertainty.
Datum: the LiDAR is written with a fault of its coordinates and goes through `ingest`, `align` and
`refine`. A run that was stopped is carried on. See README.md beside this file.

python bench/planted_errors.py --scene ../shared/real/marseille
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import laspy
import numpy as np
import pyproj
from accuracy import print_table
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereotruth.alignment import refine as refinement
from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import RPC_TILT, align, from_rpcs
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
from stereotruth.lidar.declared_crs import header_crs
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.numerics.robust import reweighted_fit, robust_sigma, tukey_weights
from stereotruth.products.ungeoreferenced import open_raster

Floats = NDArray[np.float64]
VIEWS = ("left", "right")
QUANTITIES = ("disparity", "y_parallax", "x", "y")
MEASURED_PX = 0.25  # noise of a control point's image coordinates
WITHHELD = 0.6  # of the places: what trials have in common is one draw of the scene's own errors
KINDS = ("left col", "left row", "right col", "right row", "both shifted", "tilt", "affine")
SIZES_PX = (0.2, 0.5, 1.0, 2.0, 5.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A pair with what is known of it; ``true`` the sensor models that its check points ask for.

    ``xyz`` [n, 3]: all its LiDAR, in the coordinates of its files, which ``crs`` tells.
    """

    images: tuple[Path, Path]
    sizes: tuple[tuple[int, int], tuple[int, int]]
    gcps: ControlPoints
    checks: ControlPoints
    true: tuple[SensorModel, SensorModel]
    xyz: Floats
    crs: pyproj.CRS


def opened(folder: Path) -> Scene:
    """The scene of a folder: left.tif, right.tif, gcps.csv, checkpoints.csv, lidar/."""
    images = folder / "left.tif", folder / "right.tif"
    checks = read_gcps(folder / "checkpoints.csv")
    true, sizes = [], []
    for image, measured in zip(images, (checks.left, checks.right)):
        rpc = read_rpc(image)
        seen = np.isfinite(measured[:, 0])
        predicted = SensorModel(rpc).project(
            checks.lon[seen], checks.lat[seen], checks.height[seen]
        )
        system = System.of("affine", np.stack(predicted, axis=1), measured[seen])
        true.append(SensorModel(rpc, system.affine(system.solve(np.ones(seen.sum(), bool)))))
        with open_raster(image) as dataset:
            sizes.append((dataset.width, dataset.height))
    files = sorted(p for p in (folder / "lidar").iterdir() if p.suffix in (".las", ".laz"))
    read = [laspy.read(file) for file in files]
    declared = header_crs(read[0].header)[0]
    xyz = np.concatenate([np.asarray(las.xyz) for las in read])
    gcps = read_gcps(folder / "gcps.csv")
    return Scene(images, tuple(sizes), gcps, checks, tuple(true), xyz, declared.horizontal)


def lidar_offset(scene: Scene) -> tuple[Floats, Floats]:
    """How far the LiDAR lies off the check points (x, y, z in m), and its standard error.

    By planes through the points around each check point, which see a shift on their slopes.
    """
    to_file = pyproj.Transformer.from_crs("EPSG:4326", scene.crs, always_xy=True)
    at = np.stack([*to_file.transform(scene.checks.lon, scene.checks.lat), scene.checks.height])
    tree = cKDTree(scene.xyz[:, :2])
    rows, seen = [], []
    for point in at.T:
        near = scene.xyz[tree.query_ball_point(point[:2], 3.0)] - point
        if len(near) < 30:
            continue
        design = np.column_stack([near[:, :2], np.ones(len(near))])
        plane = np.linalg.lstsq(design, near[:, 2], rcond=None)[0]
        if (near[:, 2] - design @ plane).std() < 0.4:
            rows.append([-plane[0], -plane[1], 1.0])
            seen.append(plane[2])
    a, b = np.array(rows), np.array(seen)
    plain = np.linalg.lstsq(a, b, rcond=None)[0]
    offset = reweighted_fit(a, b, tukey_weights, least_sigma=1e-4, start=plain)
    sigma = robust_sigma(b - a @ offset, 1e-4)
    weight = tukey_weights((b - a @ offset) / sigma)
    covariance = sigma**2 * np.linalg.inv((a * weight[:, None]).T @ a)
    return offset, np.sqrt(np.diag(covariance))


def write_store(xyz: Floats, crs: Any, store: Path) -> list[str]:
    """Points through a LAS file and ``ingest``; its remarks."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, np.floor(xyz.mean(axis=0))
    header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.xyz = xyz
    las.return_number[:] = las.number_of_returns[:] = las.classification[:] = 1
    with TemporaryDirectory() as scratch:
        las.write(Path(scratch) / "points.las")
        return ingest(Path(scratch) / "points.las", store)["notes"]


# ------------------------------------------------------------------------------- alignment errors


def planted_affines(
    kind: str, size_px: float, sizes: Any, rng: np.random.Generator
) -> list[Floats]:
    """Affines [2, 3] of both images; tilts are ``size_px`` at the frame's edge."""
    affines = []
    for view, (cols, rows) in zip(VIEWS, sizes):
        linear, shift = np.zeros((2, 2)), np.zeros(2)
        if kind.startswith(view):
            shift[("col", "row").index(kind.split()[1])] = rng.choice([-1, 1]) * size_px
        elif kind in ("both shifted", "affine"):
            shift = rng.choice([-1, 1], 2) * size_px
        if kind in ("tilt", "affine"):
            linear = rng.choice([-1, 1], (2, 2)) * size_px / (max(cols, rows) / 2)
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
        with open_raster(image) as source:
            pixels, kind = source.read(), source.dtypes[0]
        _, rows, cols = pixels.shape
        shape = {"driver": "GTiff", "count": 1, "dtype": kind, "width": cols, "height": rows}
        files.append(folder / f"{VIEWS[len(files)]}.tif")
        with open_raster(files[-1], "w", **shape) as target:
            target.write(pixels)
            target.update_tags(ns="RPC", ERR_BIAS="-1", ERR_RAND="-1", **tags)
    return files


def write_gcps(
    scene: Scene, count: int, noise_px: float, file: Path, rng: np.random.Generator
) -> None:
    """A random part of the control points, where the true sensors see them, measured anew."""
    points = scene.gcps
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for i in np.sort(rng.permutation(len(points.ids))[:count]):
            ground = points.lon[i], points.lat[i], points.height[i]
            row = [points.ids[i], *(repr(float(v)) for v in ground)]
            for sensor in scene.true:
                row += [repr(float(v) + noise_px * rng.normal()) for v in sensor.project(*ground)]
            writer.writerow(row)


def withheld_by(seed: int) -> Callable[[Site], bool]:
    """Which sites are withheld: random parts of the left image, the same wherever it is asked."""
    field = np.random.default_rng([seed, 1]).uniform(size=(1024, 1024))
    return lambda site: bool(field[int(site[1]) // SITE, int(site[0]) // SITE] < WITHHELD)


def errors_left(
    alignment: Alignment, scene: Scene, places: Floats, shown: Floats
) -> dict[str, Any]:
    """Errors px of labels at LiDAR ``places`` [3, n] that show ``shown``, with stated deviations.

    disparity and y-parallax of true correspondences, and the place (x, y) of labels.
    """
    model = epipolar_model(alignment)
    left, right = (sensor.project(*shown) for sensor in scene.true)
    x_left, y_left = model.left_to_epipolar(*left)
    x_right, y_right = model.right_to_epipolar(*right)
    label = model.ground_to_epipolar(*places)
    sigma, sigma_x, sigma_y = label_sigma(alignment, model, x_left, y_left)
    across = [
        image.slopes(*at)[:, 1:] @ fit.design(*at)
        for image, at, fit in zip(
            (model.left_image, model.right_image), (left, right), alignment.fits
        )
    ]
    across = np.concatenate([across[0][:, 0], -across[1][:, 0]], axis=-1)
    variance = np.einsum("ni,ij,nj->n", across, alignment.covariance, across)
    errors = {
        "disparity": (label[0] - label[2] - (x_left - x_right), sigma),
        "y_parallax": (y_right - y_left, np.sqrt(np.maximum(variance, 0.0))),
        "x": (label[0] - x_left, sigma_x),
        "y": (label[1] - y_left, sigma_y),
    }
    return {
        name: {
            "rms": float(np.sqrt(np.nanmean(error**2))),
            "mean": float(np.nanmean(error)),
            "sigma": float(np.nanmean(deviation)),
            "within": float(np.nanmean(np.abs(error) < deviation)),
            "within_2": float(np.nanmean(np.abs(error) < 2 * deviation)),
        }
        for name, (error, deviation) in errors.items()
    }


def ground_of(points: ControlPoints, most: int = 400) -> Floats:
    """Lon, lat, height [3, n] of at most about ``most`` points."""
    every = max(1, len(points.ids) // most)
    return np.stack([points.lon, points.lat, points.height])[:, ::every]


def at_withheld(
    alignment: Alignment, images: Sequence[Path], scene: Scene, store: PointStore, withheld: Any
) -> dict[str, float]:
    """Medians px of disparity and y-parallax at tie points that took no part."""
    model = epipolar_model(alignment)
    sensors = alignment.left, alignment.right
    with open_pair(*images) as sources:
        sites = [s for s in choose_sites(*sensors, scene.sizes, [store]) if withheld(s)]
        places = find_places(*sensors, sources[0], [store], sites)
        ties = match(places, Geometry.of(places, *sensors), sources, 6)
    if len(ties) < 10:
        return {"ties": len(ties)}
    slopes = model.right_image.slopes(ties.right[:, 0], ties.right[:, 1])
    along, across = np.median(np.einsum("nab,nb->na", slopes, ties.shift), axis=0)
    return {"ties": len(ties), "along": float(along), "across": float(across)}


def alignment_trial(scene: Scene, store: PointStore, seed: int, with_gcps: bool) -> dict[str, Any]:
    """One planted error and what is left of it."""
    rng = np.random.default_rng([seed, int(with_gcps)])
    kind, size_px = KINDS[seed % len(KINDS)], SIZES_PX[seed // len(KINDS) % len(SIZES_PX)]
    record: dict[str, Any] = {"kind": kind, "size_px": size_px, "with_gcps": with_gcps}
    withheld = withheld_by(seed)
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        images = write_moved(scene, planted_affines(kind, size_px, scene.sizes, rng), folder)
        try:
            if with_gcps:
                record["gcps"] = int(rng.integers(5, len(scene.gcps.ids) + 1))
                write_gcps(scene, record["gcps"], MEASURED_PX, folder / "gcps.csv", rng)
                start = align(*images, folder / "gcps.csv", seed=seed, provenance={})
            else:
                start = from_rpcs(*images, provenance={})
            with (
                mock.patch.object(
                    refinement,
                    "choose_sites",
                    lambda *given: [s for s in choose_sites(*given) if not withheld(s)],
                ),
                mock.patch.object(refinement, "PointStore", lambda path: store),
            ):
                refined, _ = refine(start, *images, [store.path])
        except InputError as error:
            return record | {"refused": str(error)}
        ground = ground_of(scene.checks)
        return record | {
            "applied": bool(refined.refinement["applied"]),
            "remarks": list(refined.warnings[len(start.warnings) :]),
            "start": errors_left(start, scene, ground, ground),
            "left": errors_left(refined, scene, ground, ground),
            "withheld": at_withheld(refined, images, scene, store, withheld),
        }


# ----------------------------------------------------------------------------------- datum faults


def undulation(xyz: Floats) -> Floats:
    """A geoid's height in m, about that of the south of France, with its usual slope."""
    middle = xyz[:, :2].mean(axis=0)
    return 49.4 + (xyz[:, :2] - middle) @ (2e-5, -1e-5)


def scaled(*factors: float) -> Callable[[Floats], Floats]:
    return lambda xyz: xyz * np.array(factors)


def moved_by(*metres: float) -> Callable[[Floats], Floats]:
    return lambda xyz: xyz + np.array(metres)


FOOT, US_FOOT = 0.3048, 1200 / 3937
FAULTS: dict[str, tuple[Callable[[Floats], Floats], str | None]] = {
    "none": (lambda xyz: xyz, None),
    "geoid left out": (lambda xyz: xyz - np.outer(undulation(xyz), (0, 0, 1)), None),
    "geoid added twice": (lambda xyz: xyz + np.outer(undulation(xyz), (0, 0, 1)), None),
    "international feet taken as metres": (scaled(1, 1, 1 / FOOT), None),
    "US survey feet taken as metres": (scaled(1, 1, 1 / US_FOOT), None),
    "metres taken as international feet": (scaled(1, 1, FOOT), None),
    "metres taken as US survey feet": (scaled(1, 1, US_FOOT), None),
    "x, y, z in US survey feet taken as international": (scaled(*[FOOT / US_FOOT] * 3), None),
    "UTM zone one too far west": (lambda xyz: xyz, "west"),
    "UTM zone one too far east": (lambda xyz: xyz, "east"),
    "southern hemisphere": (lambda xyz: xyz, "south"),
    "ED50 taken as WGS 84": (moved_by(82.0, 204.0, 0.0), None),
    **{
        f"heights {sign * metres:+g} m": (moved_by(0.0, 0.0, sign * metres), None)
        for metres in (0.3, 0.5, 1, 2, 3, 5, 10, 15, 20, 30, 40, 60)
        for sign in (1, -1)
    },
    **{
        f"{metres:g} m too far east": (moved_by(metres, 0.0, 0.0), None)
        for metres in (1.0, 2.0, 5.0, 10.0)
    },
}
UNTOLD = "cannot be told"  # what is said of every pair without control points
FAR_PX = 1000.0  # farther off, no label is left
CONTROLS = ("all", "four", "none")  # which control points: as they are, four with noise, none


def system_of(scene: Scene, fault: str) -> pyproj.CRS:
    """What the file of a fault declares."""
    other = FAULTS[fault][1]
    if other is None:
        return scene.crs
    code = scene.crs.to_epsg()
    changed = {"west": code - 1, "east": code + 1, "south": code + 100}
    return pyproj.CRS.from_epsg(changed[other])


def datum_trial(
    scene: Scene, fault: str, control: str, store: Path, notes: list[str], refused: str
) -> dict[str, Any]:
    """One fault: refused, or the remarks of align and refine and what labels are off.

    ``notes``, ``refused``: what ``ingest`` said.
    """
    if refused:
        return {"refused": refused}
    record: dict[str, Any] = {"notes": notes}
    with TemporaryDirectory() as scratch:
        file = Path(scratch) / "gcps.csv"
        try:
            if control == "none":
                start = from_rpcs(*scene.images, provenance={})
            else:
                count = len(scene.gcps.ids) if control == "all" else 4
                noise = 0.0 if control == "all" else MEASURED_PX
                write_gcps(scene, count, noise, file, np.random.default_rng(2))
                start = align(*scene.images, file, provenance={})
            refined, _ = refine(start, *scene.images, [store])
        except InputError as error:
            return record | {"refused": str(error)}
    shown = ground_of(scene.checks)
    to_file = pyproj.Transformer.from_crs("EPSG:4326", scene.crs, always_xy=True)
    back = pyproj.Transformer.from_crs(system_of(scene, fault), "EPSG:4326", always_xy=True)
    there = FAULTS[fault][0](np.stack([*to_file.transform(*shown[:2]), shown[2]], axis=1))
    places = np.stack([*back.transform(there[:, 0], there[:, 1]), there[:, 2]])
    return record | {
        "remarks": list(refined.warnings),
        "reason": refined.refinement["reason"],
        "height": refined.refinement.get("lidar_height"),
        "left": errors_left(refined, scene, places, shown),
    }


# ------------------------------------------------------------------------------------------ tables


def usual(record: Mapping[str, Any], scene: Scene) -> bool:
    """Whether the planted tilt is one that RPCs have, which is all that a pair has without GCPs."""
    tilt = record["size_px"] / (max(scene.sizes[0]) / 2)
    return record["with_gcps"] or record["kind"] not in ("tilt", "affine") or tilt < 3 * RPC_TILT


def alignment_rows(records: Sequence[Mapping[str, Any]], scene: Scene) -> list[dict[str, str]]:
    """Errors before and after, by kind of planted error; share of them below the stated sigma.

    Median and 95th percentile of the trials' rms errors; the share is the mean of the trials'
    shares of places, with the standard error of that mean.
    """
    rows = []
    for what, with_gcps in (("with", True), ("without", False)):
        own = [r for r in records if r["with_gcps"] == with_gcps]
        parts = {kind: [r for r in own if r["kind"] == kind] for kind in KINDS}
        parts |= {"all": own, "all, tilts as RPCs'": [r for r in own if usual(r, scene)]}
        for kind, trials in parts.items():
            done = [r for r in trials if "left" in r]
            if not done:
                continue
            row = {"GCPs": what, "planted": kind, "trials": str(len(trials))}
            row["refused"] = str(len(trials) - len(done))
            row["remarks"] = str(sum(any(UNTOLD not in t for t in r["remarks"]) for r in done))
            for name in QUANTITIES[:2]:
                before, after = ([r[s][name]["rms"] for r in done] for s in ("start", "left"))
                row[f"{name} px: before"] = f"{np.median(before):.2f}"
                row[f"{name}: left, 95 %"] = (
                    f"{np.median(after):.3f}, {np.percentile(after, 95):.3f}"
                )
            worse = [max(r["left"][name]["rms"] for name in QUANTITIES[:2]) for r in done]
            row["< 0.1 px"] = f"{100 * np.mean(np.array(worse) < 0.1):.0f} %"
            for name in QUANTITIES:
                within = np.array([r["left"][name]["within"] for r in done])
                error = within.std() / len(done) ** 0.5
                row[f"{name} < sigma"] = f"{100 * within.mean():.0f} ± {100 * error:.0f} %"
            rows.append(row)
    return rows


def withheld_rows(records: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Medians at tie points that took no part, over the trials."""
    rows = []
    for what in ("with control points", "without"):
        part = [
            r["withheld"]
            for r in records
            if r["with_gcps"] == (what != "without") and r.get("withheld", {}).get("along")
        ]
        if part:
            row = {"control": what, "trials": str(len(part))}
            row["ties"] = f"{np.mean([p['ties'] for p in part]):.0f}"
            for name in ("along", "across"):
                values = np.array([p[name] for p in part])
                row[name] = f"mean {values.mean():+.3f}, rms {np.sqrt(np.mean(values**2)):.3f} px"
            rows.append(row)
    return rows


def found(record: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    """What was said of a fault that is not said of the scene as it is."""
    if "refused" in record:
        return "refused"
    words = {
        "not refined": "not refined",
        "point within": "control points",
        "m of height (": "tie points' height",
        "tie points alone": "tie points' place",
        "of the RPC:": "RPC's heights",
    }
    new = [text for text in record["remarks"] if text not in usual["remarks"]]
    told = dict.fromkeys(word for text in new for key, word in words.items() if key in text)
    untold = next((text for text in record["remarks"] if UNTOLD in text), "")
    if told or not untold:
        return ", ".join(told) or "–"
    return "– (below " + re.search(r"less than (\d+ m)", untold)[1] + ")"


def datum_rows(records: Mapping[tuple[str, str], Mapping[str, Any]]) -> list[dict[str, str]]:
    """By fault: what was found with all, four and no control points, and what labels are off."""
    rows = []
    for fault in FAULTS:
        row = {"fault": fault}
        for control in CONTROLS:
            record = records.get((fault, control))
            if record is None:
                continue
            row[f"{control} control points"] = found(record, records["none", control])
            off = record.get("left", {}).get("disparity", {}).get("mean")
            row[f"off px ({control})"] = f"{off:+.2f}" if off and abs(off) < FAR_PX else ""
        rows.append(row)
    return rows


# -------------------------------------------------------------------------------------------- main


class Records:
    """Lines of JSON, one per trial, that a second run takes over."""

    def __init__(self, file: Path) -> None:
        self.file = file
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        self.known = {r["key"]: r for r in map(json.loads, text.splitlines())}

    def add(self, key: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The record of a key, made if it is not there."""
        if key not in self.known:
            self.known[key] = {"key": key, **make()}
            with self.file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(self.known[key]) + "\n")
        return self.known[key]


def alignment_part(scene: Scene, folder: Path, trials: int, framed: bool) -> None:
    name = "framed" if framed else "as_is"
    if framed:
        offset, error = lidar_offset(scene)
        print("LiDAR less check points, m:", offset.round(3), "standard error", error.round(3))
    store = folder / f"{name}.points"
    if not store.exists():
        write_store(scene.xyz - (offset if framed else 0.0), scene.crs, store)
    loaded = PointStore(store)
    records = Records(folder / f"alignment_{name}.jsonl")
    done = []
    for seed in range(trials):
        for with_gcps in (True, False):
            make = partial(alignment_trial, scene, loaded, seed, with_gcps)
            done.append(records.add(f"{seed} {with_gcps}", make))
    print_table(f"alignment errors, {name}", alignment_rows(done, scene))
    print_table("tie points that took no part", withheld_rows(done))


def datum_part(scene: Scene, folder: Path) -> None:
    records = Records(folder / "datum.jsonl")
    store = folder / "fault.points"
    done = {}
    for fault, (change, _) in FAULTS.items():
        keys = {f"{fault}, {control}": control for control in CONTROLS}
        refused, notes = "", []
        if not records.known.keys() >= keys.keys():
            shutil.rmtree(store, ignore_errors=True)
            try:
                notes = write_store(change(scene.xyz), system_of(scene, fault), store)
            except InputError as error:
                refused = str(error)
        for key, control in keys.items():
            make = partial(datum_trial, scene, fault, control, store, notes, refused)
            done[fault, control] = records.add(key, make)
    shutil.rmtree(store, ignore_errors=True)
    print_table("datum faults", datum_rows(done))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scene", type=Path, required=True, help="folder: left.tif, right.tif, …")
    parser.add_argument("--folder", type=Path, default=Path("results/planted_errors"))
    parser.add_argument("--part", choices=("alignment", "datum"), help="default: both")
    parser.add_argument("--trials", type=int, default=210, help="with and without control points")
    parser.add_argument(
        "--framed", action="store_true", help="first move the LiDAR to where the check points are"
    )
    given = parser.parse_args()
    logging.disable(logging.WARNING)  # what is said of planted errors stands in the tables
    given.folder.mkdir(parents=True, exist_ok=True)
    scene = opened(given.scene)
    if given.part != "datum":
        alignment_part(scene, given.folder, given.trials, given.framed)
    if given.part != "alignment":
        datum_part(scene, given.folder)


if __name__ == "__main__":
    main()
