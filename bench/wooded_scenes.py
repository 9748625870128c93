"""Scenes for alignments: cities with crowns, drawn by seed, and the errors of an alignment there.

A scene is a pair of images with biased RPCs, point stores of any density and control points, made
once and found again by what it was drawn from. Errors are those of labels at exact places.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from synthetic_pairs import VIEWS, Change, gain, noise, sun_an_hour_later

from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import align, from_rpcs
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import open_stores
from stereotruth.matching.image_faults import as_images
from stereotruth.products.files import atomic_folder
from stereotruth.products.ungeoreferenced import open_raster
from stereotruth.simulate.cities import (
    Canopy,
    CitySpec,
    Jitter,
    SceneSpec,
    ViewSpec,
    lidar_files,
    training_city,
)
from stereotruth.simulate.control_points import simulate_points
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.render import simulate_image
from stereotruth.simulate.surfaces import TREE
from stereotruth.simulate.truth import SURFACES, truth_at

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


@dataclass(frozen=True)
class Draw:
    """What a scene is drawn from.

    ``zones``: land use, one of ZONES. ``ground_m2`` per crown, None for no crowns, and what follows
    it: as in :class:`Canopy`. ``density``: LiDAR points per m². ``noise``, ``gain``: of both
    images, as in :mod:`synthetic_pairs`. ``later``: the right image is of an hour later. ``bare``:
    the view without leaves, or "". ``vehicles`` per hectare. ``relief_m``: height range of the
    ground. ``roofs``: "mixed" or "flat". ``buildings``: share of them that is built. ``sun_deg``:
    the sun's elevation, None for one that is drawn. ``jitter_px``, ``psf_px`` (left, right),
    ``saturates``: as in :class:`.cities.Jitter` and :class:`.cities.ViewSpec`.
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
class Scene:
    """The files of a draw, made under ``folder`` when they are first asked for."""

    draw: Draw
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
                changes: list[Change] = [
                    change for change, asked in ((noise, self.draw.noise), (gain, self.draw.gain))
                    if asked
                ]  # fmt: skip
                self._change([scratch / f"{view}.tif" for view in VIEWS], changes)
        return [made / f"{view}.tif" for view in VIEWS]

    def _change(self, images: Sequence[Path], changes: Sequence[Change]) -> None:
        rng = np.random.default_rng([self.draw.seed, 9])
        for image in images if changes else ():
            with open_raster(image) as source:
                profile, pixels, rpcs = source.profile, source.read(1), source.rpcs
            changed = pixels.astype(np.float32)
            for change in changes:
                changed = change(changed, rng)
            (changed,) = as_images([changed], [pixels])
            with open_raster(image, "w", **profile, rpcs=rpcs) as target:
                target.write(changed, 1)

    @cached_property
    def stores(self) -> list[Path]:
        """Point stores of the draw's density."""
        looks = (
            "noise", "gain", "later", "brightness", "ground_look", "jitter_px", "psf_px",
            "saturates",
        )  # fmt: skip
        made = self.folder / "lidar" / self.draw.key(*looks)
        if not _readable(made):
            with atomic_folder(made) as scratch:
                for file in lidar_files(self.city, self.spec):
                    simulate_lidar_tile(
                        self.city, self.spec, file, scratch / file,
                        spacing_m=self.draw.density**-0.5, seed=self.draw.seed,
                    )  # fmt: skip
                    ingest(scratch / file, scratch / f"{Path(file).stem}.points")
                    (scratch / file).unlink()
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
                writer.writerows(rows[k] for k in _spread(at, count))
        return made

    def align(self, gcps: int) -> Alignment:
        """The alignment by so many control points; by the RPCs alone without any."""
        if not gcps:
            return from_rpcs(*self.images, provenance={})
        return align(*self.images, self.gcps(gcps), provenance={})

    def errors(self, alignment: Alignment) -> LabelErrors:
        """What an alignment makes of exact places of this scene."""
        return label_errors(alignment, self.city, self.spec)


def _readable(folder: Path) -> bool:
    """Whether a folder has point stores, in the format of this version."""
    stores = list(folder.glob("*.points"))
    try:
        open_stores(stores)
    except InputError:
        return False
    return bool(stores)


def _spread(at: Floats, count: int) -> list[int]:
    """Indices of ``count`` places [n, 2], each as far as can be from those before."""
    chosen = [int(np.argmin(at.sum(axis=1)))]
    while len(chosen) < min(count, len(at)):
        away = np.min([np.hypot(*(at - at[k]).T) for k in chosen], axis=0)
        chosen.append(int(np.argmax(away)))
    return sorted(chosen)


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

    def __str__(self) -> str:
        return (
            f"bias {self.bias:+.3f}, mean abs {self.mean_absolute:.3f}, y-parallax rms "
            f"{self.parallax_rms:.3f} px at {self.disparity.size} places"
        )


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
