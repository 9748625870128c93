"""Scenes that are drawn by seed, or twins of real places, and the errors of an alignment there.

A scene is a pair of images with biased RPCs, point stores of any density and control points, made
once and found again by what it was drawn from. Errors are those of labels at exact places. Some
cities, by seeds that nothing is tuned on, are aligned, refined, labelled and compared as a whole.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from synthetic_pairs import (
    VIEWS,
    change_images,
    far_apart,
    fly,
    gain,
    label_by,
    noise,
    sun_an_hour_later,
)

from stereocities.cities import Canopy, CitySpec, Jitter, SceneSpec, ViewSpec, training_city
from stereocities.control_points import simulate_points
from stereocities.render import simulate_image
from stereocities.surfaces import TREE
from stereocities.truth import SURFACES, truth_at
from stereocities.twin_world import twin_city
from stereotruth.align.adjustment import epipolar_model
from stereotruth.align.align import align, from_rpcs
from stereotruth.align.alignment import Alignment
from stereotruth.align.refine import refine
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.numerics.statistics import ErrorSum
from stereotruth.core.products.files import atomic_folder
from stereotruth.core.products.provenance import source_digest
from stereotruth.evaluate.epipolar_truth import write_grid_truth
from stereotruth.evaluate.labels_against_truth import SceneComparison, compare_scene

Floats = NDArray[np.float64]
STEP_PX = 8.0  # between the places where an alignment is examined
STEP_M = 0.5  # of height between a place and where its label lies: more is another surface
ZONES = {
    "suburb": {"lowrise": 2, "village": 3, "slabs": 0.7, "park": 1.5, "fields": 1},
    "park": {"park": 5, "village": 1.5, "fields": 0.5},
    "town": {"towers": 1.5, "slabs": 3, "lowrise": 3, "industry": 1, "park": 1},
}
LOW = {"trunk_m": (0.0, 0.3), "slimness": (0.4, 0.7)}  # bushes, orchards
HIGH = {"trunk_m": (0.4, 2.2), "slimness": (0.75, 1.1)}
MIXED = {"trunk_m": (0.0, 2.2), "slimness": (0.4, 1.1)}
COMPARED = Path("results/accuracy/drawn")  # folder of the cities that are compared as a whole
DENSITIES = (4.0, 1.0)  # points/m², of these
GCPS = 15
TWIN_SEED = 27


@dataclass(frozen=True)
class Draw:
    """What a scene is drawn from.

    ``zones``: land use, one of ZONES. ``ground_m2`` per crown, None for no crowns, and what follows
    it: as in :class:`.cities.Canopy`. ``density``: LiDAR points per m². ``noise``, ``gain``: of
    both images, as in :mod:`synthetic_pairs`. ``later``: the right image is of an hour later.
    ``bare``: the view without leaves, or "". ``vehicles`` per hectare. ``relief_m``: height range
    of the ground. ``roofs``: "mixed" or "flat". ``buildings``: share of them that is built.
    ``sun_deg``: the sun's elevation, None for one that is drawn. ``jitter_px``, ``psf_px`` (left,
    right), ``saturates``: as in :class:`.cities.Jitter` and :class:`.cities.ViewSpec`.
    """

    seed: int
    zones: str = "suburb"
    ground_m2: float | None = 250.0
    arrangement: str = "single"
    radius_m: tuple[float, float] = (1.5, 4.5)
    brightness: float = 0.35
    ground_look: tuple[float, float] = (1.5, 0.3)
    lobes: int = 8
    porosity: float = 0.35
    trunk_m: tuple[float, float] = (0.4, 2.2)
    slimness: tuple[float, float] = (0.75, 1.1)
    density: float = 4.0
    noise: bool = False
    gain: bool = False
    later: bool = False
    bare: str = ""
    vehicles: float = 0.0
    relief_m: float = 12.0
    roofs: str = "mixed"
    buildings: float = 0.7
    side_px: int = 2000
    sun_deg: float | None = None
    jitter_px: float = 0.0
    psf_px: tuple[float, float] = (0.42, 0.42)
    saturates: float | None = None

    @property
    def city(self) -> CitySpec:
        """The city and its one scene, "Wooded"."""
        drawn = training_city(self.seed, 27, self.side_px)
        canopy = None
        if self.ground_m2 is not None:
            canopy = Canopy(
                self.arrangement, self.ground_m2, self.radius_m, self.lobes, self.brightness,
                self.porosity, self.trunk_m, self.slimness,
            )  # fmt: skip
        character = replace(
            drawn.character, relief_m=self.relief_m, valley=0.3, wavelength_m=900.0, river_m=0.0,
            max_slope_deg=30.0, lakes=0.0, zones=ZONES[self.zones], towers_m=(20.0, 40.0),
            trees=0.0, zone_m=260.0, canopy=canopy, ground_look=self.ground_look,
            buildings=self.buildings, flat_roofs=self.roofs == "flat", vehicles=self.vehicles,
        )  # fmt: skip
        scene = replace(drawn.scenes[0], name="Wooded", lidar_grid=(1, 1))
        city = replace(
            drawn,
            name="Wooded",
            character=character,
            las_format="las-1.4-6",
            scenes=(scene,),
            sun_elevation_deg=self.sun_deg or drawn.sun_elevation_deg,
        )
        views = {
            view: ViewSpec(
                sun_an_hour_later(city) if self.later and view == "right" else None,
                bare=self.bare == view,
                jitter=Jitter(self.jitter_px) if self.jitter_px else None,
                psf_px=psf_px,
                saturates=self.saturates,
            )
            for view, psf_px in zip(VIEWS, self.psf_px)
        }
        return replace(city, **views)

    def key(self, *without: str) -> str:
        """A name that tells what is drawn apart from other draws, ``without`` some fields."""
        told = {k: v for k, v in asdict(self).items() if k not in without}
        return f"{self.seed}-{hashlib.sha256(repr(told).encode()).hexdigest()[:12]}"


@dataclass(frozen=True)
class Place:
    """A LAS or LAZ file, and the coordinate system of its points if it declares none."""

    file: Path
    crs: str = ""

    def city(self, name: str, seed: int) -> CitySpec:
        """The twin, whose orbit and textures a seed draws."""
        return twin_city(name, self.file, crs=self.crs, pose_seed=seed)

    @property
    def key(self) -> str:
        """A name that tells the places apart."""
        size = self.file.stat().st_size
        told = f"{self.file.name} {size} {self.crs}".encode()
        return f"{self.file.stem}-{hashlib.sha256(told).hexdigest()[:8]}"


@dataclass(frozen=True)
class TwinDraw:
    """What the scene of a twin is made of, in the place of a :class:`Draw`."""

    place: Place
    seed: int
    density: float
    noise: bool = False
    gain: bool = False
    key = Draw.key

    @property
    def city(self) -> CitySpec:
        """The twin and its one scene."""
        return self.place.city("Twin", self.seed)


def add_place(parser: argparse.ArgumentParser) -> None:
    """The arguments that name a place."""
    parser.add_argument("--twin", type=Path, help="LAS or LAZ file of a real place: its twin")
    parser.add_argument("--crs", default="", help="of the twin's points, if they declare none")


def place_given(arguments: argparse.Namespace) -> Place | None:
    """The place that is named and there; else None, with the reason if it is not there."""
    if arguments.twin is None:
        return None
    if not arguments.twin.is_file():
        print(f"twin skipped: there is no file {arguments.twin}")
        return None
    return Place(arguments.twin, arguments.crs)


@dataclass(frozen=True)
class Scene:
    """The files of a draw, made under ``folder`` when they are first asked for."""

    draw: Draw | TwinDraw
    folder: Path

    @cached_property
    def city(self) -> CitySpec:
        """The city that is drawn."""
        return self.draw.city

    @property
    def spec(self) -> SceneSpec:
        """Its one scene."""
        return self.city.scenes[0]

    @cached_property
    def images(self) -> list[Path]:
        """left.tif and right.tif."""
        made = self.folder / "images" / self.draw.key("density")
        if not made.is_dir():
            with atomic_folder(made) as scratch:
                for view in VIEWS:
                    simulate_image(self.city, self.spec, view, scratch / f"{view}.tif",
                                   seed=self.draw.seed)  # fmt: skip
                asked = (noise, self.draw.noise), (gain, self.draw.gain)
                if changes := [change for change, is_asked in asked if is_asked]:
                    rng = np.random.default_rng([self.draw.seed, 9])
                    change_images([scratch / f"{view}.tif" for view in VIEWS], changes, rng)
        return [made / f"{view}.tif" for view in VIEWS]

    @cached_property
    def stores(self) -> list[Path]:
        """Point stores of the draw's density."""
        looks = (
            "noise", "gain", "later", "brightness", "ground_look", "jitter_px", "psf_px",
            "saturates",
        )  # fmt: skip
        made = self.folder / "lidar" / self.draw.key(*looks)
        if not made.is_dir():
            with atomic_folder(made) as scratch:
                fly(self.city, self.spec, scratch, self.draw.seed, self.draw.density**-0.5)
        return sorted(made.glob("*.points"))

    @property
    def points(self) -> list[Path]:
        """Point stores, by the name that a :class:`synthetic_pairs.Pair` has for them."""
        return self.stores

    def alignment(self, rectified: Path) -> Path:
        """The alignment that the pair was rectified with into a folder."""
        return rectified / "alignment.json"

    @cached_property
    def crown_share(self) -> float:
        """Share of the left image that shows crowns."""
        cols, rows = self.spec.cols, self.spec.rows
        at = np.meshgrid(np.arange(0, cols, 2 * STEP_PX), np.arange(0, rows, 2 * STEP_PX))
        surface = truth_at(self.city, self.spec, *at)["surface"]
        return float((surface == TREE).sum() / (surface > 0).sum())

    def gcps(self, count: int) -> Path:
        """gcps.csv of so many control points of 0.25 px noise, spread over the scene."""
        made = self.images[0].parent / f"gcps_{count}.csv"
        if not made.is_file():
            folder = made.parent
            tables = [folder / f"{name}.csv" for name in ("measured", "exact", "checkpoints")]
            simulate_points(self.city, self.spec, *tables, seed=self.draw.seed)
            with tables[0].open(newline="", encoding="utf-8") as stream:
                rows = list(csv.DictReader(stream))
            at = np.array([[float(row["left_col"]), float(row["left_row"])] for row in rows])
            with made.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.DictWriter(stream, rows[0])
                writer.writeheader()
                writer.writerows(rows[k] for k in far_apart(at, count))
        return made

    def align(self, gcps: int) -> Alignment:
        """The alignment by so many control points; by the RPCs alone without any."""
        if not gcps:
            return from_rpcs(*self.images, provenance={})
        return align(*self.images, self.gcps(gcps), provenance={})

    def errors(self, alignment: Alignment) -> LabelErrors:
        """What an alignment makes of exact places of this scene."""
        return label_errors(alignment, self.city, self.spec)


@dataclass(frozen=True, eq=False)
class LabelErrors:
    """Errors (px) of labels at n exact places that both views show, by the alignment alone.

    ``disparity``: of the label less the true one of the very pixel in which the label lies, so that
    its wrong place counts; ``parallax``: y of the right image's point less that of the left one;
    ``x``, ``y``: the label's place in the left grid less the true one. ``at`` [n, 2]: place there.
    ``surface``: index into the truth's SURFACES.
    """

    disparity: Floats
    parallax: Floats
    x: Floats
    y: Floats
    at: Floats
    surface: NDArray[np.uint8]

    @property
    def bias(self) -> float:
        """Mean error of disparity, px."""
        return float(self.disparity.mean())

    @property
    def mean_absolute(self) -> float:
        """Mean absolute error of disparity, px."""
        return float(np.abs(self.disparity).mean())

    @property
    def parallax_rms(self) -> float:
        """Root mean square of the y-parallax, px."""
        return float(np.sqrt(np.mean(self.parallax**2)))

    def by_surface(self) -> dict[str, float]:
        """Mean absolute error of disparity by kind of surface."""
        return {
            name: float(np.abs(self.disparity[self.surface == k]).mean())
            for k, name in enumerate(SURFACES.split())
            if (self.surface == k).any()
        }


def label_errors(
    alignment: Alignment, city: CitySpec, scene: SceneSpec, step_px: float = STEP_PX
) -> LabelErrors:
    """Errors of labels that an alignment would give to exact surface points of a scene.

    Of every ``step_px``-th place of the raw left image whose surface point is seen by both images
    and, unchanged, by the LiDAR, and whose label stays on its surface.
    """
    model = epipolar_model(alignment)
    cols, rows = model.left_size
    col, row = (
        a.ravel() for a in np.meshgrid(np.arange(0, cols, step_px), np.arange(0, rows, step_px))
    )
    exact = truth_at(city, scene, col, row)
    use = (exact["visible_right"] == 1) & (exact["changed"] == 0) & (exact["covered"] == 1)
    col, row = col[use], row[use]
    exact = {name: values[use] for name, values in exact.items()}
    label = model.ground_to_epipolar(exact["lon"], exact["lat"], exact["height"])
    x_left, y_left = model.left_to_epipolar(col, row)
    _, y_right = model.right_to_epipolar(exact["right_col"], exact["right_row"])
    here = truth_at(city, scene, *model.epipolar_to_left(label[0], label[1]))
    x_here, _ = model.right_to_epipolar(here["right_col"], here["right_row"])
    found = np.stack([
        label[0] - label[2] - (label[0] - x_here), y_right - y_left, label[0] - x_left,
        label[1] - y_left,
    ])  # fmt: skip
    same = (
        (np.abs(here["height"] - exact["height"]) < STEP_M)
        & (here["surface"] == exact["surface"])
        & (here["visible_right"] == 1)
        & np.isfinite(found).all(axis=0)
    )
    at = np.column_stack([x_left, y_left])[same]
    return LabelErrors(*found[:, same], at, exact["surface"][same])


NAMED = {
    "suburb": Draw(
        61803, zones="suburb", ground_m2=110.0, arrangement="single", brightness=0.4,
        ground_look=(1.5, 0.5), buildings=0.9, relief_m=15.0, vehicles=4.0, side_px=1400, **MIXED,
    ),
    "park": Draw(
        41421, zones="park", ground_m2=70.0, arrangement="forest", brightness=0.5,
        ground_look=(1.4, 0.4), buildings=0.8, relief_m=25.0, side_px=1400, **MIXED,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Compared:
    """A drawn city against its truth.

    ``labels``: of the whole grid. ``alignments``: errors of disparity and y-parallax at exact
    places, by the control points alone and as used.
    """

    name: str
    labels: SceneComparison
    alignments: dict[str, tuple[ErrorSum, ErrorSum]]


def compare_drawn(name: str, density: float, settings: LabelSettings, workers: int) -> Compared:
    """Labels and alignment of a city of NAMED at a density of its LiDAR."""
    scene = Scene(replace(NAMED[name], density=density), COMPARED)
    return _compared(
        scene, f"{name}-{density:g}", f"{name}, {density:g} points/m²", settings, workers
    )


def compare_twin(place: Place, density: float, settings: LabelSettings, workers: int) -> Compared:
    """The same of the twin of a place."""
    scene = Scene(TwinDraw(place, TWIN_SEED, density), COMPARED)
    title = f"twin of {place.file.stem}, {density:g} points/m²"
    return _compared(scene, f"{place.key}-{density:g}", title, settings, workers)


def _compared(
    scene: Scene, key: str, title: str, settings: LabelSettings, workers: int
) -> Compared:
    """Labels and alignment of a scene, made once in a folder that has its ``key``."""
    alone = scene.align(GCPS)
    code = source_digest("stereotruth.align.refine", "stereotruth.labels.project")[:8]
    made = COMPARED / f"{key}-{code}"
    if not made.is_dir():
        with atomic_folder(made) as scratch:
            refined, _ = refine(alone, *scene.images, scene.stores, provenance={})
            label_by(refined, scene.images, scene.stores, scratch, settings, workers=workers)
            write_grid_truth(scene.city, scene.spec, scratch / "epipolar.json",
                             scratch / "truth.zarr", workers=workers)  # fmt: skip
    used = Alignment.read(made / "alignment.json")
    labels = compare_scene(
        made / "disparity.zarr", made / "truth.zarr", None, scene=title, workers=workers
    )
    alignments = {}
    for word, alignment in (("GCPs", alone), ("as used", used)):
        errors = scene.errors(alignment)
        alignments[word] = ErrorSum(), ErrorSum()
        for total, values in zip(alignments[word], (errors.disparity, errors.parallax)):
            total.add(values)
    return Compared(title, labels, alignments)
