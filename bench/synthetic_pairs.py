"""Synthetic pairs that benchmarks label: made anew, or as the workflow left them; under conditions.

A condition says how the pair was imaged and aligned: with exact control points, with noise in its
images, with nothing that refines it. Everything is made once, and found again by its folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import align
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.refine import refine
from stereotruth.config.configuration import Configuration
from stereotruth.config.labels import LabelSettings
from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.epipolar.image_reader import open_pair
from stereotruth.epipolar.rectify import rectify
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.strip_comparison import compare_strips
from stereotruth.matching.image_faults import as_images, smooth
from stereotruth.products.files import atomic_folder
from stereotruth.products.provenance import source_digest
from stereotruth.products.ungeoreferenced import open_raster
from stereotruth.simulate.cities import (
    CITIES,
    CitySpec,
    SceneSpec,
    ViewSpec,
    lidar_files,
    training_city,
)
from stereotruth.simulate.control_points import simulate_points
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.render import simulate_image

VIEWS = ("left", "right")
SEED = 12  # of the fresh cities, their control points' noise and the faults of images
SPACING_M = 0.4
SIDE_PX = 1320  # of a fresh city's left image: 1024 px of its grid are seen and covered all over
NOISE_DN = 20.0
GAIN = 0.05
GAIN_PX = 128  # how wide the features of the gain field are
HOUR_DEG = 15.0

Image = NDArray[np.float32]
Change = Callable[[Image, np.random.Generator], Image]


def noise(image: Image, rng: np.random.Generator) -> Image:
    """White noise of NOISE_DN grey values."""
    return image + rng.normal(0, NOISE_DN, image.shape).astype(np.float32)


def gain(image: Image, rng: np.random.Generator) -> Image:
    """A smooth random field of factors whose standard deviation is GAIN."""
    field = smooth(image.shape, GAIN_PX, rng)
    return image * (1 + GAIN * (field - field.mean()) / field.std())


def sun_an_hour_later(city: CitySpec) -> tuple[float, float]:
    """Azimuth and elevation of the sun an hour later on the same day, degrees.

    From the city's place and the sun's hour angle.
    """
    lat, azimuth, height = map(
        math.radians, (city.lat, city.sun_azimuth_deg, city.sun_elevation_deg)
    )
    north = math.cos(height) * math.cos(azimuth)
    east = math.cos(height) * math.sin(azimuth)
    pole = math.sin(height) * math.sin(lat) + north * math.cos(lat)  # sine of the declination
    meridian = math.sin(height) * math.cos(lat) - north * math.sin(lat)
    angle = math.atan2(-east, meridian) + math.radians(HOUR_DEG)
    across = math.hypot(east, meridian)
    east, meridian = -across * math.sin(angle), across * math.cos(angle)
    north = pole * math.cos(lat) - meridian * math.sin(lat)
    up = pole * math.sin(lat) + meridian * math.cos(lat)
    return math.degrees(math.atan2(east, north)) % 360.0, math.degrees(math.asin(up))


def labels_of(config: Configuration) -> LabelSettings:
    """How points become labels by a configuration."""
    return LabelSettings(**{name: getattr(config.project, name) for name in vars(LabelSettings())})


@dataclass(frozen=True)
class Condition:
    """How a pair was imaged and aligned."""

    exact_gcps: bool = False
    refined: bool = True
    change: Change | None = None  # of both images
    later: bool = False  # the right image is of an hour later

    def images(self, pair: Pair, folder: Path) -> list[Path]:
        """The pair's images, or changed ones in the folder."""
        images = [pair.data / f"{view}.tif" for view in VIEWS]
        if self.later:
            made = folder / "right.tif"
            later = replace(pair.city, right=ViewSpec(sun_deg=sun_an_hour_later(pair.city)))
            simulate_image(later, pair.spec, "right", made, seed=SEED)
            return [images[0], made]
        if self.change is None:
            return images
        rng = np.random.default_rng([SEED, pair.spec.pose_seed])
        for image in images:
            with open_raster(image) as source:
                profile, pixels, rpcs = source.profile, source.read(1), source.rpcs
            (changed,) = as_images([self.change(pixels.astype(np.float32), rng)], [pixels])
            with open_raster(folder / image.name, "w", **profile, rpcs=rpcs) as target:
                target.write(changed, 1)
        return [folder / image.name for image in images]


def rectify_pair(images: Sequence[Path], gcps: Path, stores: Sequence[Path], folder: Path) -> None:
    """Align a pair, refine that by the points if there are any, and rectify it.

    Makes ``alignment.json``, ``epipolar.json``, ``left.zarr`` and ``right.zarr`` in the folder.
    """
    alignment = align(*images, gcps)
    if stores:
        alignment, _ = refine(alignment, *images, stores)
    rectify_by(alignment, images, folder)


def rectify_by(
    alignment: Alignment, images: Sequence[Path], folder: Path, *, workers: int = 1
) -> None:
    """Rectify a pair: ``alignment.json``, ``epipolar.json``, ``left.zarr``, ``right.zarr``."""
    alignment.save(folder / "alignment.json")
    model = epipolar_model(alignment)
    with open_pair(*images) as opened:
        rectify(
            *opened,
            model,
            folder / "epipolar.json",
            *(folder / f"{view}.zarr" for view in VIEWS),
            workers=workers,
        )


def label_by(
    alignment: Alignment,
    images: Sequence[Path],
    stores: Sequence[Path],
    folder: Path,
    settings: LabelSettings,
    *,
    workers: int = 1,
) -> Path:
    """Rectify a pair by an alignment into a folder and label it: its ``disparity.zarr``."""
    rectify_by(alignment, images, folder, workers=workers)
    made = folder / "disparity.zarr"
    rectified = (folder / f"{view}.zarr" for view in VIEWS)
    code = source_digest("disparity.project")
    alignment_file = folder / "alignment.json"
    strips = folder / "points.strips"
    compare_strips([PointStore(path) for path in stores]).write(strips)
    inputs = SceneInputs.of(*rectified, stores, settings, alignment=alignment_file, strips=strips)
    inputs = inputs.with_surface(folder, workers)
    project_scene(inputs, made, workers=workers, code=code)
    return made


CONDITIONS = {
    "plain": Condition(),
    "exact": Condition(exact_gcps=True, refined=False),
    "misaligned": Condition(refined=False),
    "noise": Condition(change=noise),
    "gain": Condition(change=gain),
    "shadows": Condition(later=True),
}


@dataclass(frozen=True)
class Pair:
    """A synthetic pair: images in ``data``, stages' products in ``results``."""

    city: CitySpec
    name: str
    data: Path
    results: Path

    @property
    def spec(self) -> SceneSpec:
        """The scene's specification."""
        return self.city.scene(self.name)

    @property
    def points(self) -> list[Path]:
        """Point stores."""
        return sorted((self.results / "ingest" / self.city.name / self.name).glob("*.points"))

    def rectified(self, condition: str, folder: Path) -> Path:
        """The folder of epipolar.json, left.zarr and right.zarr under a condition.

        ``plain`` of a pair of the workflow: its own. Others are made once in ``folder``.
        """
        own = self.results / "rectify" / self.city.name / self.name
        if condition == "plain" and own.is_dir():
            return own
        made = folder / condition / self.name
        if not made.is_dir():
            with atomic_folder(made) as scratch:
                self._rectify(CONDITIONS[condition], scratch)
        return made

    def alignment(self, rectified: Path) -> Path:
        """The alignment that the pair was rectified with into a folder."""
        own = self.results / "refine" / self.city.name / self.name / "alignment.json"
        made = rectified / "alignment.json"
        return made if made.is_file() else own

    def _rectify(self, condition: Condition, folder: Path) -> None:
        tables = [folder / f"{name}.csv" for name in ("gcps", "gcps_exact", "checkpoints")]
        simulate_points(self.city, self.spec, *tables, seed=SEED)
        images = condition.images(self, folder)
        gcps = tables[1] if condition.exact_gcps else tables[0]
        rectify_pair(images, gcps, self.points if condition.refined else [], folder)
        for image in images:
            if image.parent == folder:
                image.unlink()


def made_pair(scene: str, results: Path) -> Pair:
    """A scene of the six cities, as the workflow left it."""
    city = CITIES[scene.rsplit("-", 1)[0]]
    return Pair(city, scene, results.parent / "data" / "synthetic" / city.name / scene, results)


def fresh_pair(number: int, folder: Path) -> Pair:
    """City ``number`` of those that nothing is tuned on: drawn, imaged and flown, made once."""
    drawn = training_city(number, SEED, SIDE_PX)
    name = f"Fresh-{number}"
    city = replace(drawn, name=name, scenes=(replace(drawn.scenes[0], name=name),))
    pair = Pair(city, name, folder / "data" / name, folder / "results")
    if not pair.data.is_dir():
        with atomic_folder(pair.data) as data:
            for view in VIEWS:
                simulate_image(city, pair.spec, view, data / f"{view}.tif", seed=SEED)
            for file in lidar_files(city, pair.spec):
                simulate_lidar_tile(
                    city, pair.spec, file, data / "lidar" / file, spacing_m=SPACING_M, seed=SEED
                )
    stores = pair.results / "ingest" / name / name
    if not stores.is_dir():
        with atomic_folder(stores) as scratch:
            for file in lidar_files(city, pair.spec):
                store = scratch / f"{Path(file).stem}.points"
                ingest(pair.data / "lidar" / file, store)
    return pair
