"""Changes planted in what the LiDAR says of a real scene: who notices, and what is lost besides.

python bench/planted_changes.py --project FOLDER [--scenes jax-1-2] [--draws 1 2] [--folder FOLDER]

What real images show is left as it is, with its shadows, noise and compression, and the LiDAR is
altered at places that are known: roofs are cut out (built), boxes stand on open ground
(demolished), parts of roofs are moved up and down (raised), crowns stand on open ground (felled) or
are cut out (grown), and boxes of a car's size (cars). Without classes pits take the place of roofs.
The ``--project`` is the folder of a run, of which the scenes are rectified and aligned.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import cv2
import laspy
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    binary_opening,
    distance_transform_edt,
    grey_opening,
    uniform_filter,
)

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.products.files import atomic_folder
from stereotruth.core.status import Status, is_labelled
from stereotruth.labels.change_evidence import LabelledWindow
from stereotruth.labels.change_probability import change_probability, least_probability
from stereotruth.labels.pair_window import PairWindow, WindowLabels
from stereotruth.labels.recipe import image_window, labels_around
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import WATER_CLASS
from stereotruth.sensor.image_noise import EQUAL
from stereotruth.surface.make_surface import make_surface

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
KINDS = "built", "demolished", "raised", "felled", "grown", "cars"
CELL_M = 1.0  # of the rasters that places are found in
APART_M = 6.0  # between planted things
GROUND, TREE, ROOF = 2, 5, 6  # ASPRS
ALTERED_M, SAME_M = 0.8, 0.1  # heights that differ by more have changed, by less have not
SHARES = {
    "built": 0.04,
    "demolished": 0.04,
    "raised": 0.03,
    "felled": 0.03,
    "grown": 0.02,
    "cars": 0.006,
}  # of the ground, at most
FIRST_DAY, DAY_S, GPS_EPOCH_S = 14000, 86400.0, 1e9  # days since 1980-01-06 stand for kinds
OFF_PX = 1.0  # labels that matching contradicts by more, or within so many px,
BESIDE_PX = 3  # count for nothing
# Small things first, while there is room for them.
ORDER = "cars", "felled", "grown", "raised", "demolished", "built"
NEAR_PX = 20  # what has changed or has lost its label there is of the kind that is nearest
HIDDEN = Status.HIDDEN_IN_LEFT, Status.HIDDEN_IN_RIGHT


class Points(NamedTuple):
    """Of a LiDAR file: plan position and height (m) [3, n], class (ASPRS), and the kind of change
    that is planted there, 1 the first of KINDS and 0 none."""

    xyz: Floats
    surface_class: NDArray[np.uint8]
    kind: NDArray[np.uint8]


class Plan(NamedTuple):
    """Rasters of CELL_M [h, w] from ``corner``: highest point and ground (m), class of the highest,
    and places that are taken."""

    corner: Floats
    top: Floats
    ground: Floats
    surface_class: NDArray[np.uint8]
    taken: Bools

    @classmethod
    def of(cls, points: Points) -> Plan:
        """Of a file."""
        xy, z = points.xyz[:2], points.xyz[2]
        corner = xy.min(axis=1)
        col, row = ((xy - corner[:, None]) / CELL_M).astype(np.int64)
        shape = row.max() + 1, col.max() + 1
        order = np.argsort(z, kind="stable")
        row, col = row[order], col[order]
        top, low = np.full((2, *shape), np.nan)
        classes = np.zeros(shape, np.uint8)
        top[row, col], classes[row, col] = z[order], points.surface_class[order]
        low[row[::-1], col[::-1]] = z[order][::-1]
        is_ground = np.isfinite(low)
        if (points.surface_class == GROUND).any():
            is_ground &= classes == GROUND
        empty = np.isnan(low)
        filled = _nearest(low, is_ground)
        if not (points.surface_class == GROUND).any():
            filled = grey_opening(filled, size=(25, 25))
        return cls(corner, np.where(empty, filled, top), uniform_filter(filled, 5), classes,
                   binary_dilation(empty, iterations=2))  # fmt: skip

    def open_ground(self) -> Bools:
        """Even cells that nothing stands on."""
        rough = uniform_filter(np.abs(self.top - uniform_filter(self.top, 5)), 5)
        is_open = (self.top - self.ground < 0.5) & (rough < 0.15)
        if (self.surface_class == GROUND).any():
            is_open &= self.surface_class == GROUND
        return is_open


def _nearest(values: Floats, known: Bools) -> Floats:
    index = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(index)]


class Thing(NamedTuple):
    """Something planted: its middle (m), half axes (m), direction (rad) and height (m)."""

    x: float
    y: float
    a: float
    b: float
    angle: float
    height: float

    def inside(self, xy: Floats, is_round: bool) -> tuple[NDArray[np.int64], Floats]:
        """Which of the points [2, n], and how far from the middle, 1 at the rim."""
        near = np.flatnonzero(
            (np.abs(xy[0] - self.x) < self.a + self.b) & (np.abs(xy[1] - self.y) < self.a + self.b)
        )
        dx, dy = xy[0, near] - self.x, xy[1, near] - self.y
        along = (dx * np.cos(self.angle) + dy * np.sin(self.angle)) / self.a
        across = (dy * np.cos(self.angle) - dx * np.sin(self.angle)) / self.b
        far = np.hypot(along, across) if is_round else np.fmax(np.abs(along), np.abs(across))
        return near[far < 1.0], far[far < 1.0]


def _drawn(kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """Half axes and height (m) of a thing."""
    if kind in ("felled", "grown"):
        radius = rng.uniform(1.2, 4.0)
        return radius, radius, rng.uniform(1.5, 3.0) * radius
    if kind == "cars":
        return 2.25, 0.95, rng.uniform(1.3, 1.8)
    low = 2.0 if kind == "raised" else 3.0
    height = rng.uniform(low, 12.0) * (rng.choice([-1, 1]) if kind == "raised" else 1)
    return rng.uniform(4.0, 12.0), rng.uniform(3.0, 8.0), height


def plant(points: Points, seed: int) -> Points:
    """The points with changes of all kinds, as many as find a place."""
    rng = np.random.default_rng([seed, 50])
    plan = Plan.of(points)
    xyz, classes, kinds = (values.copy() for values in points)
    is_classed = (points.surface_class == ROOF).any()
    places = {"ground": plan.open_ground(), "roof": plan.surface_class == ROOF,
              "tree": plan.surface_class == TREE}  # fmt: skip
    on = dict.fromkeys(KINDS, "ground") | {"built": "roof", "raised": "roof", "grown": "tree"}
    if not is_classed:
        on |= {"built": "ground"}  # pits
    for kind in ORDER:
        number = KINDS.index(kind) + 1
        allowed = places[on[kind]]
        wanted = SHARES[kind] * plan.taken.size * CELL_M**2
        for _ in range(4000):
            if wanted <= 0.0 or not allowed.any():
                break
            thing = _placed(plan, allowed, kind, rng)
            if thing is None:
                continue
            chosen, far = thing.inside(points.xyz[:2], kind in ("felled", "grown"))
            if chosen.size < 4:
                continue
            ground = _at(plan, plan.ground, points.xyz[:2, chosen])
            noise = rng.normal(0.0, 0.03, chosen.size)
            before = points.xyz[2, chosen]
            if kind == "built":
                after = ground + noise if is_classed else before - thing.height
                classes[chosen] = GROUND if is_classed else classes[chosen]
            elif kind == "grown":
                after = ground + noise
                classes[chosen] = GROUND
            elif kind == "felled":
                after = ground + thing.height * np.sqrt(1.0 - far**2) + 8.0 * noise
                classes[chosen] = TREE if is_classed else classes[chosen]
            else:
                after = before + thing.height
                if kind == "demolished" and is_classed:
                    classes[chosen] = ROOF
            xyz[2, chosen] = after
            kinds[chosen[np.abs(after - before) > ALTERED_M]] = number
            wanted -= 4.0 * thing.a * thing.b
    return Points(xyz, classes, kinds)


def _at(plan: Plan, raster: Floats, xy: Floats) -> Floats:
    col, row = ((xy - plan.corner[:, None]) / CELL_M).astype(np.int64)
    return raster[row, col]


def _placed(plan: Plan, allowed: Bools, kind: str, rng: np.random.Generator) -> Thing | None:
    """A thing of a kind on allowed ground, whose place is taken then; None: there is none here."""
    row, col = np.unravel_index(rng.choice(np.flatnonzero(allowed)), allowed.shape)
    a, b, height = _drawn(kind, rng)
    x, y = plan.corner + (np.array([col, row]) + 0.5) * CELL_M
    thing = Thing(x, y, a, b, rng.uniform(0.0, np.pi), height)
    reach = int((a + b + APART_M) / CELL_M) + 1
    if not (reach < row < allowed.shape[0] - reach and reach < col < allowed.shape[1] - reach):
        return None
    around = np.s_[row - reach : row + reach + 1, col - reach : col + reach + 1]
    j, i = np.mgrid[around]
    xy = plan.corner[:, None] + (np.stack([i.ravel(), j.ravel()]) + 0.5) * CELL_M
    cells = np.zeros(xy.shape[1], np.bool_)
    cells[thing.inside(xy, False)[0]] = True
    cells = cells.reshape(i.shape)
    wide = binary_dilation(cells, iterations=int(APART_M / CELL_M))
    if plan.taken[around][wide].any() or allowed[around][cells].mean() < 0.9:
        return None
    plan.taken[around] |= cells
    return thing


@dataclass(frozen=True)
class RealScene:
    """A scene of a project that has been run."""

    project: Path
    name: str
    diachronic: bool = False

    @cached_property
    def row(self) -> dict[str, str]:
        """Of the scenes sheet."""
        with (self.project / "scenes.tsv").open(encoding="utf-8") as stream:
            rows = {row["scene"]: row for row in csv.DictReader(stream, delimiter="\t")}
        return rows[self.name]

    @property
    def files(self) -> list[Path]:
        """Of the LiDAR."""
        path = self.project / self.row["lidar"]
        return sorted(path.glob("*.la[sz]")) if path.is_dir() else [path]

    def inputs(self, stores: list[Path]) -> SceneInputs:
        """What labels follow from, by other points."""
        parts = self.row["city"], self.name
        results = self.project / "results"
        aligned = [
            results / stage / Path(*parts) / "alignment.json" for stage in ("adjust", "refine")
        ]
        views = (results / "rectify" / Path(*parts) / f"{view}.zarr" for view in ("left", "right"))
        inputs = SceneInputs.of(
            *views, stores, LabelSettings(diachronic=self.diachronic),
            alignment=next(path for path in aligned if path.is_file()),
        )  # fmt: skip
        surface = stores[0].parent / "made.surface"
        if not surface.exists():  # all pairs of a place have one
            make_surface(inputs.stores, surface, cell=inputs.rays.cell)
        return replace(inputs, surface=surface)

    def stores(self, folder: Path, draw: int) -> list[Path]:
        """Of the points as they are (draw 0) or with changes, made once in a folder."""
        made = folder / f"{self.row['city']}-{draw}"
        if not made.is_dir():
            with atomic_folder(made) as scratch:
                for number, file in enumerate(self.files):
                    altered = scratch / file.name
                    _write(file, altered, [draw, number])
                    ingest(
                        altered, scratch / f"{file.stem}.points",
                        lidar_crs=self.row.get("lidar_crs") or None,
                        geoid=self.row.get("geoid") or None,
                    )  # fmt: skip
                    altered.unlink()
        return sorted(made.glob("*.points"))


def _write(file: Path, target: Path, draw: list[int]) -> None:
    """A file with the changes of a draw, whose days stand for their kinds."""
    las = laspy.read(file)
    classes = np.asarray(las.classification, np.uint8)
    points = Points(np.array(las.xyz.T), classes, np.zeros(classes.size, np.uint8))
    if draw[0]:
        points = plant(points, draw[0] * 100 + draw[1])
    las.z, las.classification = points.xyz[2], points.surface_class
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las.gps_time = (FIRST_DAY + points.kind.astype(np.float64)) * DAY_S - GPS_EPOCH_S
    las.write(target)


class Truth(NamedTuple):
    """Labelled pixels [h, w] of a window that have ``changed`` (or are hidden by what has) and
    those that are the ``same``; those that had a label before something was planted beside them
    and have none now (``unlabelled``); the ``kind`` of what has changed there, 0 for none."""

    changed: Bools
    same: Bools
    unlabelled: Bools
    kind: NDArray[np.uint8]


class Planted(NamedTuple):
    """A window whose labels follow from altered points: what images of equal noise show, and what
    is true."""

    window: PairWindow
    labels: WindowLabels
    labelled: Bools
    truth: Truth

    @property
    def compared(self) -> LabelledWindow:
        """What the images say of the labels."""
        return LabelledWindow(
            self.window, self.labels.labels, self.labelled, self.labels.surface_class, EQUAL
        )

    @classmethod
    def of(cls, scene: RealScene, folder: Path, draw: int) -> Planted:
        """The whole of a scene, with the changes of a draw, none of draw 0."""
        (window, before), (_, after) = (
            _by_lidar(scene.inputs(scene.stores(folder, n))) for n in (0, draw)
        )
        known, labelled = is_labelled(before.status), is_labelled(after.status)
        labelled &= after.surface_class != WATER_CLASS
        day, first = (
            after.day.astype(np.int64),
            FIRST_DAY + 3657,
        )  # days from 1970-01-01 to 1980-01-06
        kind = np.where((day > first) & labelled, day - first, 0).astype(np.uint8)
        with np.errstate(invalid="ignore"):
            off = np.abs(after.height - before.height)
            changed = labelled & ((kind > 0) | known & (off > ALTERED_M)
                                  | np.isin(before.status, HIDDEN))  # fmt: skip
            same = labelled & known & (off < SAME_M) & ~changed
        unlabelled = known & ~labelled & (before.surface_class != WATER_CLASS)
        far, nearest = distance_transform_edt(kind == 0, return_indices=True)
        kind = np.where(far <= NEAR_PX, kind[tuple(nearest)], 0).astype(np.uint8)
        unlabelled &= kind > 0
        off, found = by_matching(window, after.labels.disparity)
        # what one of two days shows alone, as a car, matches nowhere
        same &= found & ~off if scene.diachronic else ~off
        equal = window.of_equal_noise(scene.inputs(scene.stores(folder, 0)).noise)
        return cls(equal, after, labelled, Truth(changed, same, unlabelled, kind))


def _by_lidar(inputs: SceneInputs) -> tuple[PairWindow, WindowLabels]:
    rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
    by_lidar = labels_around(inputs, rows, cols)
    return image_window(inputs, rows, cols, by_lidar), by_lidar.labels


def by_matching(window: PairWindow, disparity: Floats) -> tuple[Bools, Bools]:
    """Where semi-global matching finds another surface, and where it finds any: the LiDAR is older
    than the images, and what has changed between them in truth is no part of what is planted."""
    known = np.isfinite(disparity)
    low = int(np.floor(disparity[known].min())) - 16
    count = -(-(int(np.ceil(disparity[known].max())) + 16 - low) // 16) * 16
    left, _ = window.images_at(disparity)
    top = window.rows.start - window.right.row
    right = np.zeros_like(left)
    first = window.right.col - window.cols.start
    here = slice(max(first, 0), min(first + window.right.usable.shape[1], left.shape[1]))
    right[:, here] = window.right.pixels[
        top : top + len(left), here.start - first : here.stop - first
    ]
    images = []
    for image in (left, right):
        low_dn, high_dn = np.quantile(image[image > 0], [0.001, 0.999])
        scaled = 255.0 * np.sqrt(np.clip((image - low_dn) / (high_dn - low_dn), 0.0, 1.0))
        images.append(np.pad(scaled.astype(np.uint8), ((0, 0), (count, count))))
    found = (
        cv2.StereoSGBM_create(
            low, count, 5, 8 * 25, 32 * 25, 1, 63, 5, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY
        )
        .compute(*images)[:, count:-count]
        .astype(np.float64)
        / 16.0
    )
    has_match = found >= low
    with np.errstate(invalid="ignore"):
        off = has_match & (np.abs(found - disparity) > OFF_PX)
    around = binary_dilation(binary_opening(off, np.ones((3, 3))), iterations=BESIDE_PX)
    return off | around, has_match


def main() -> None:
    """Print what is found and lost of each scene."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--project", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--diachronic", action="store_true")
    parser.add_argument("--draws", type=int, nargs="+", default=[1])
    parser.add_argument("--folder", type=Path, default=Path("results/planted"))
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    print("| scene | " + " | ".join(KINDS) + " | unchanged lost, % | as it is, % |")
    print("|---" * (len(KINDS) + 3) + "|")
    for name in given.scenes:
        scene = RealScene(given.project, name, given.diachronic)
        counts = np.zeros((len(KINDS) + 1, 2), np.int64)
        as_it_is = np.zeros(2, np.int64)
        for draw in given.draws:
            planted = Planted.of(scene, given.folder, draw)
            lost = lost_of(planted, scene.diachronic)
            for number in range(1, len(KINDS) + 1):
                chosen = planted.truth.kind == number
                left_out = (lost & planted.truth.changed) | planted.truth.unlabelled
                every = planted.truth.changed | planted.truth.unlabelled
                counts[number - 1] += (left_out & chosen).sum(), (every & chosen).sum()
            counts[-1] += (lost & planted.truth.same).sum(), planted.truth.same.sum()
            plain = Planted.of(scene, given.folder, 0)
            same = planted.truth.same & plain.labelled
            as_it_is += (lost_of(plain, scene.diachronic) & same).sum(), same.sum()
        cells = [f"{100.0 * a / max(b, 1):.1f}" for a, b in [*counts, as_it_is]]
        print("| " + " | ".join([name, *cells]) + " |", flush=True)


def lost_of(planted: Planted, diachronic: bool) -> Bools:
    """Labels of a window that the images contradict."""
    compared = planted.compared
    probability = change_probability(compared, diachronic).probability
    return planted.labelled & (probability > least_probability(compared))


if __name__ == "__main__":
    main()
