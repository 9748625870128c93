"""What changed between LiDAR and images: who notices, what is lost, which reason is told.

python bench/changes.py [--seeds 1 2] [--kinds built felled] [--density 4] [--folder FOLDER]
                        [--without-classes]
                        [--twin place.laz --crs EPSG:2154]

Cities are drawn by seed, one for each kind of change and one with many (mixed), and each of them is
made under two conditions: both images of one day three years after the LiDAR; or the right image a
year after the left one, under another sun. Truth is exact: a ray through each pixel meets the
worlds of both images and of the LiDAR. With a LAS or LAZ file its twin takes the place of cities.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from drawn_scenes import Place, add_place, place_given
from numpy.typing import NDArray
from synthetic_pairs import VIEWS, change_images, fly, gain, noise, rectify_by

from stereocities.cities import Canopy, CitySpec, Dates, ViewSpec, training_city
from stereocities.control_points import simulate_points
from stereocities.render import simulate_image
from stereocities.surfaces import TREE, WATER
from stereocities.truth import REASONS, changes_at
from stereotruth.align.align import align
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.products.files import atomic_folder
from stereotruth.core.products.grids import require_complete
from stereotruth.core.status import Status, is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.epipolar_truth import truth_window
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs

FIRST_CITY = 4000  # of the numbers of cities
SIDE_PX = 800
CHANGED_M = 1.0  # of height
YEAR = 365.0
TOWN = {"slabs": 1.0, "lowrise": 2.0, "village": 1.5, "park": 1.0, "fields": 1.0}
SHARES = {
    "built": {"built": 0.25},
    "demolished": {"demolished": 0.25},
    "raised": {"raised": 0.25},
    "felled": {"felled": 0.25},
    "grown": {"grown": 0.25},
    "moved": {},
    "water": {"water_m": 1.6},
    "crops": {"crops": 0.5},
    "texture": {"resurfaced": 0.6},
    "nothing": {},
    "noise": {},
    "sun": {},
    "leaves": {},
    "mixed": {
        "built": 0.15, "demolished": 0.15, "raised": 0.1, "felled": 0.2, "grown": 0.2, "crops": 0.3,
    },
}  # fmt: skip
SHARES["mixed in noise"] = SHARES["mixed"]
SHARES["woods"] = {}
SPOILT = "noise", "mixed in noise"  # images of little contrast and much noise
WOODED = "leaves", "woods"
CONDITIONS = ("one day", "a year apart")
OF_TWINS = (
    "built", "demolished", "raised", "felled", "grown", "nothing", "noise", "sun", "mixed",
    "mixed in noise",
)  # fmt: skip
ALONE = {"texture": "a year apart", "sun": "a year apart", "leaves": "a year apart"}
LATER_SUN_DEG = (35.0, -12.0)  # azimuth and elevation of the right image's sun less the left's

HEADER = ["kind", "images", "changed, 1000 px", "without a label, %", "of these `changed`, %",
          "right reason, %", "unchanged lost, %", "error, px", "σ, px", "within σ, %",
          "within 2 σ, %"]  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A kind of change in a drawn city under a condition, at a density of the LiDAR, points/m²,
    whose points have classes or none, and whose images have so many px a side; or in the twin of a
    place."""

    kind: str
    condition: str
    seed: int
    density: float
    classed: bool = True
    twin: Place | None = None
    side_px: int = SIDE_PX

    @property
    def apart(self) -> bool:
        """Whether the images are a year apart."""
        return self.condition == CONDITIONS[1]

    @cached_property
    def city(self) -> CitySpec:
        """The city, with its one scene."""
        number = FIRST_CITY + list(SHARES).index(self.kind)
        if self.twin is not None:
            return self._dated(self.twin.city("Dated", self.seed))
        drawn = training_city(number, self.seed, self.side_px)
        is_open = self.kind in ("crops", "noise")
        water = self.kind == "water"
        character = replace(
            drawn.character, relief_m=8.0, valley=0.3, wavelength_m=700.0, max_slope_deg=15.0,
            river_m=70.0 if water else 0.0, lakes=0.0, zone_m=200.0, towers_m=(20.0, 45.0),
            zones={"fields": 4.0, "village": 1.0, "park": 0.5} if is_open else TOWN,
            vehicles=8.0 if self.kind in ("moved", "mixed", "mixed in noise") else 0.0,
            canopy=Canopy(ground_m2=150.0) if self.kind in WOODED else None,
            ground_look=(1.0, 0.3) if self.kind in SPOILT else (1.0, 1.0),
        )  # fmt: skip
        scene = replace(drawn.scenes[0], name="Dated", lidar_grid=(1, 1))
        drawn = replace(drawn, name="Dated", character=character, scenes=(scene,))
        return self._dated(drawn)

    def _dated(self, drawn: CitySpec) -> CitySpec:
        """A city with the dates and the light of this case."""
        dates = Dates(3 * YEAR, (4 if self.apart else 3) * YEAR, 0.0, **SHARES[self.kind])
        sun = None
        if self.apart and self.kind != "texture":
            azimuth, elevation = LATER_SUN_DEG
            sun = (
                drawn.sun_azimuth_deg + azimuth, max(drawn.sun_elevation_deg + elevation, 30.0)
            )  # fmt: skip
        return replace(drawn, dates=dates, right=ViewSpec(sun, bare=self.kind == "leaves"))

    def make(self, folder: Path) -> None:
        """Images, points and exact control points, aligned and rectified, into a folder."""
        city, (spec,) = self.city, self.city.scenes
        images = [folder / f"{view}.tif" for view in VIEWS]
        for view, image in zip(VIEWS, images):
            simulate_image(city, spec, view, image, seed=self.seed)
        if self.kind in SPOILT:
            change_images(images, [noise, gain], np.random.default_rng([self.seed, 9]))
        tables = [folder / f"{name}.csv" for name in ("measured", "exact", "checkpoints")]
        simulate_points(city, spec, *tables, seed=self.seed)
        fly(city, spec, folder, self.seed, self.density**-0.5, classed=self.classed)
        rectify_by(align(*images, tables[1], provenance={}), images, folder)

    def made(self, folder: Path) -> Path:
        """The folder of :meth:`make`, made once."""
        parts = self.kind, self.condition, str(self.seed), str(self.density)
        more = () if self.classed else ("unclassed",)
        more += () if self.twin is None else (self.twin.key,)
        more += () if self.side_px == SIDE_PX else (f"{self.side_px}px",)
        name = "-".join((*parts, *more)).replace(" ", "_")
        path = folder / name
        if not path.is_dir():
            with atomic_folder(path) as scratch:
                self.make(scratch)
        return path


def dated_truth(case: Case, folder: Path) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """What is true at the pixels of a case's left grid, and what has changed there; kept beside the
    images."""
    made = case.made(folder)
    model = EpipolarModel.load(made / "epipolar.json")
    rows, cols = (slice(0, side) for side in model.shape)
    kept = made.parent / f"{made.name}.npz"
    if not kept.is_file():
        y, x = np.mgrid[rows, cols].astype(np.float64)
        city, (spec,) = case.city, case.city.scenes
        truth = truth_window(model, city, spec, rows, cols)
        changes = changes_at(city, spec, *model.epipolar_to_left(x, y))
        np.savez(kept, **truth, **changes)
    with np.load(kept) as file:
        arrays = {name: file[name] for name in file}
    changes = {n: arrays.pop(n) for n in ("height", "height_other", "height_lidar", "reason")}
    return arrays, changes


def changed_and_kept(
    truth: dict[str, NDArray], changes: dict[str, NDArray]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels of :func:`dated_truth` that differ by more than CHANGED_M between the worlds; those
    that are the same in all of them, seen by both images, and no water; and those that are hidden
    from the right image instead."""
    z = changes["height"]
    with np.errstate(invalid="ignore"):
        off = np.fmax(*(np.abs(z - changes[f"height_{name}"]) for name in ("lidar", "other")))
        differs, same = off > CHANGED_M, off < 0.01
    inside = (truth["covered"] == 1) & np.isfinite(z)
    dry = truth["surface"] != WATER
    seen = (truth["visible"] == 1) & (truth["changed_right"] == 0)
    return inside & differs, inside & same & dry & seen, inside & same & dry & ~seen


def inputs_of(case: Case, folder: Path) -> SceneInputs:
    """What the labels of a case follow from."""
    made = case.made(folder)
    return SceneInputs.of(
        *(made / f"{view}.zarr" for view in VIEWS), sorted(made.glob("*.points")),
        settings_of(case), alignment=made / "alignment.json",
    ).with_surface(made, workers=2)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Labelled:
    """The layers of a case's labels, and what is true there, [y, x] of the left grid."""

    layers: dict[str, NDArray]
    truth: dict[str, NDArray]
    changes: dict[str, NDArray]

    @classmethod
    def of(cls, case: Case, folder: Path) -> Labelled:
        """Labels made anew; truth kept beside the images."""
        made = case.made(folder)
        arrays, changes = dated_truth(case, folder)
        out = made.parent / f"{made.name}.zarr"
        project_scene(inputs_of(case, folder), out, code="bench", workers=2)
        grid = require_complete(out)
        return cls({name: grid[name][:] for name in grid.array_keys()}, arrays, changes)


def settings_of(case: Case) -> LabelSettings:
    """How points become labels."""
    return LabelSettings(diachronic=case.apart)


@dataclass
class Row:
    """Counts of pixels: changed, without a label; visible and unchanged, lost to `changed`; found,
    of the right reason; errors (px) of labels of what is unchanged, their uncertainties (px), and
    how many lie within one and two of these."""

    changed: int = 0
    unlabelled: int = 0
    kept: int = 0
    lost: int = 0
    found: int = 0
    right: int = 0
    error: float = 0.0
    sigma: float = 0.0
    within: int = 0
    within_two: int = 0
    labels: int = 0

    def add(self, case: Case, of: Labelled) -> None:
        """Count the pixels of a case."""
        status, truth, changes = of.layers["status"], of.truth, of.changes
        inside = status != Status.OUT_OF_FRAME
        changed, seen, _ = (inside & pixels for pixels in changed_and_kept(truth, changes))
        known = is_labelled(status)
        if case.kind == "leaves":
            changed &= truth["surface"] == TREE
        self.changed += int(changed.sum())
        self.unlabelled += int((changed & ~known).sum())
        if case.kind == "texture":
            seen &= changes["reason"] == REASONS.split().index("texture")
        self.kept += int(seen.sum())
        self.lost += int((seen & (status == Status.CHANGED)).sum())
        found = changed & (status == Status.CHANGED)
        self.found += int(found.sum())
        if "change" in of.layers:
            self.right += int((found & (of.layers["change"] == changes["reason"])).sum())
        labels = seen & known
        self.labels += int(labels.sum())
        error = np.abs(of.layers["disparity"][labels] - truth["disparity"][labels])
        self.error += float(error.sum(dtype=np.float64))
        sigma = of.layers["uncertainty"][labels]
        self.sigma += float(sigma.sum(dtype=np.float64))
        self.within += int((error <= sigma).sum())
        self.within_two += int((error <= 2.0 * sigma).sum())

    def cells(self) -> list[str]:
        """Of the table."""

        def share(part: int, of: int) -> str:
            return f"{100.0 * part / of:.1f}" if of else "–"

        return [
            f"{self.changed / 1e3:.0f}", share(self.unlabelled, self.changed),
            share(self.found, self.changed), share(self.right, self.found),
            share(self.lost, self.kept), f"{self.error / max(self.labels, 1):.3f}",
            f"{self.sigma / max(self.labels, 1):.3f}",
            share(self.within, self.labels), share(self.within_two, self.labels),
        ]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("results/changes"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--kinds", nargs="+", default=list(SHARES), choices=list(SHARES))
    parser.add_argument("--density", type=float, default=4.0)
    parser.add_argument("--without-classes", action="store_true", help="of the LiDAR's points")
    add_place(parser)
    given = parser.parse_args()
    twin = place_given(given)
    if given.twin and twin is None:
        return
    kinds = given.kinds if twin is None else [kind for kind in given.kinds if kind in OF_TWINS]
    print("| " + " | ".join(HEADER) + " |")
    print("|---" * len(HEADER) + "|")
    for kind in kinds:
        for condition in CONDITIONS:
            if ALONE.get(kind, condition) != condition:
                continue
            row = Row()
            for seed in given.seeds:
                classed = not given.without_classes
                case = Case(kind, condition, seed, given.density, classed, twin)
                row.add(case, Labelled.of(case, given.folder))
            print("| " + " | ".join([kind, condition, *row.cells()]) + " |", flush=True)


if __name__ == "__main__":
    main()
