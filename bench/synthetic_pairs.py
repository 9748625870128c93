"""Synthetic pairs that benchmarks label, made anew or by the workflow, and blocks of them.

A condition says how a pair was imaged and aligned: with exact control points, with noise in its
images, with nothing that refines it. A block is labelled with its points thinned to any density,
and has its exact truth. Everything is made once, and found again by its folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import laspy
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stereobench.methods.image_faults import as_images, smooth
from stereocities.cities import CITIES, CitySpec, SceneSpec, ViewSpec, lidar_files, training_city
from stereocities.control_points import simulate_points
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import simulate_image
from stereotruth.align.adjustment import epipolar_model
from stereotruth.align.align import align
from stereotruth.align.alignment import Alignment
from stereotruth.align.refine import refine
from stereotruth.core.config.configuration import Configuration, LabelSettings
from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.core.products.files import atomic_folder
from stereotruth.core.products.provenance import source_digest
from stereotruth.core.products.rasters import open_raster
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rectify import rectify
from stereotruth.evaluate.epipolar_truth import truth_window
from stereotruth.evaluate.labels_against_truth import Truth
from stereotruth.labels.project import SHARD, project_scene
from stereotruth.labels.recipe import label_window
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import Points, PointStore
from stereotruth.lidar.strip_comparison import compare_strips
from stereotruth.sensor.images import open_pair

VIEWS = ("left", "right")
SEED = 12  # of the fresh cities, their control points' noise and the faults of images
SPACING_M = 0.4
SIDE_PX = 1320  # of a fresh city's left image: 1024 px of its grid are seen and covered all over
NOISE_DN = 20.0
GAIN = 0.05
GAIN_PX = 128  # how wide the features of the gain field are
HOUR_DEG = 15.0
UNCLASSIFIED = 1  # ASPRS

Image = NDArray[np.float32]
Change = Callable[[Image, np.random.Generator], Image]


def noise(image: Image, rng: np.random.Generator) -> Image:
    """White noise of NOISE_DN grey values."""
    return image + rng.normal(0, NOISE_DN, image.shape).astype(np.float32)


def gain(image: Image, rng: np.random.Generator) -> Image:
    """A smooth random field of factors whose standard deviation is GAIN."""
    field = smooth(image.shape, GAIN_PX, rng)
    return image * (1 + GAIN * (field - field.mean()) / field.std())


def change_images(
    images: Sequence[Path],
    changes: Sequence[Change],
    rng: np.random.Generator,
    folder: Path | None = None,
) -> list[Path]:
    """Change the pixels of images, in place or in copies of the same names in a folder."""
    made = [image if folder is None else folder / image.name for image in images]
    for image, out in zip(images, made):
        with open_raster(image) as source:
            profile, pixels, rpcs = source.profile, source.read(1), source.rpcs
        changed = pixels.astype(np.float32)
        for change in changes:
            changed = change(changed, rng)
        (changed,) = as_images([changed], [pixels])
        with open_raster(out, "w", **profile, rpcs=rpcs) as target:
            target.write(changed, 1)
    return made


def fly(
    city: CitySpec,
    scene: SceneSpec,
    folder: Path,
    seed: int,
    spacing_m: float | None = None,
    *,
    classed: bool = True,
) -> list[Path]:
    """Point stores of a scene's LiDAR in a folder; ``spacing_m`` None: by the city's strips."""
    spacing = {} if spacing_m is None else {"spacing_m": spacing_m}
    stores = []
    for name in lidar_files(city, scene):
        file = folder / name
        simulate_lidar_tile(city, scene, name, file, **spacing, seed=seed)
        if not classed:
            points = laspy.read(file)
            points.classification[:] = UNCLASSIFIED
            points.write(file)
        stores.append(file.with_suffix(".points"))
        ingest(file, stores[-1])
        file.unlink()
    return stores


def far_apart(at: NDArray[np.float64], count: int) -> list[int]:
    """Indices of ``count`` places [n, 2], each as far as can be from those before."""
    chosen = [int(np.argmin(at.sum(axis=1)))]
    while len(chosen) < min(count, len(at)):
        away = np.min([np.hypot(*(at - at[k]).T) for k in chosen], axis=0)
        chosen.append(int(np.argmax(away)))
    return sorted(chosen)


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
        return change_images(images, [self.change], rng, folder)


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
    code = source_digest("stereotruth.labels.project")
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
    stores = pair.results / "ingest" / name / name
    if not stores.is_dir():
        with atomic_folder(stores) as scratch:
            fly(city, pair.spec, scratch, SEED, SPACING_M)
    return pair


class Thinned(PointStore):
    """A point store of which a share of the pulses is seen, drawn by their place."""

    def __init__(self, path: Path, share: float) -> None:
        super().__init__(path)
        self.share = share
        self.count = int(self.count * share)

    @property
    def square_counts(self) -> NDArray[np.float64]:
        return super().square_counts * self.share

    def query(self, *box: float) -> Points:
        points = super().query(*box)
        if self.share >= 1.0:
            return points
        mixed = points.lon_q.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= points.lat_q.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
        kept = mixed < np.uint64(self.share * 2.0**64)
        return Points(*(getattr(points, name)[kept] for name in points.__dataclass_fields__))


def density(store: PointStore) -> float:
    """First returns per m² in the hectare in the middle."""
    box = store.bounds
    middle = [(box[k] + box[k + 2]) / 2 for k in (0, 1)]
    half = 50.0 / DEGREE_M
    wide = half / np.cos(np.radians(middle[1]))
    found = store.query(middle[0] - wide, middle[1] - half, middle[0] + wide, middle[1] + half)
    return float((found.return_number <= 1).sum()) / 100.0**2


@dataclass
class Block:
    """A block [rows, cols] of the grid of a pair that was rectified into a folder."""

    pair: Pair
    rectified: Path
    rows: slice
    cols: slice
    view: str = "left"

    @cached_property
    def density(self) -> float:
        """First returns per m² of all points: of the fullest store's, since water returns few."""
        return max(density(PointStore(path)) for path in self.pair.points)

    @cached_property
    def _layers(self) -> dict[str, NDArray]:
        """The exact truth, by rays through the pixels."""
        model = EpipolarModel.load(self.rectified / "epipolar.json")
        pair = self.pair
        return truth_window(model, pair.city, pair.spec, self.rows, self.cols, self.view)

    @cached_property
    def truth(self) -> Truth:
        """The exact truth of the block."""
        layers = xr.Dataset({name: (("y", "x"), array) for name, array in self._layers.items()})
        return Truth.read(layers, *(slice(0, side) for side in self.surface.shape))

    @property
    def surface(self) -> NDArray[np.uint8]:
        """Kind of surface of each pixel, at edges too; index into the truth's SURFACES."""
        return self._layers["surface"]

    @property
    def megapixels(self) -> float:
        """Its size."""
        return self.surface.size / 1e6

    def job(self, points_per_m2: float | None, recipe: str = "surface") -> SceneInputs:
        """What labels the block; ``points_per_m2`` None, or more than there are: all points."""
        settings = LabelSettings(recipe=recipe)
        images = (self.rectified / f"{view}.zarr" for view in ("left", "right"))
        alignment = self.pair.alignment(self.rectified)
        job = SceneInputs(*images, tuple(self.pair.points), settings, self.view, alignment)
        share = min((points_per_m2 or self.density) / self.density, 1.0)
        stores = tuple(Thinned(path, share) for path in self.pair.points)
        job.__dict__["stores"] = stores  # the surface is made of these
        job = job.with_surface(self.rectified / f"surface_{share:.9f}", workers=2)
        job.__dict__["stores"] = stores  # and so are the labels: a copy has opened none
        return job

    def compile(self, job: SceneInputs) -> None:
        """Label a corner, so that what follows is compiled."""
        label_window(job, *(slice(edge.start, edge.start + 32) for edge in (self.rows, self.cols)))

    def labels(self, job: SceneInputs) -> dict[str, NDArray]:
        """The layers of the block, put together from its windows."""
        out: dict[str, NDArray] = {}
        for rows, seen in self.windows(job):
            found = label_window(job, rows, seen)
            if found is None:
                continue
            cols = job.pair.cols(seen)
            for name, part in job.pair.arrays(found[0]).items():
                nothing = np.nan if part.dtype.kind == "f" else 0
                whole = out.setdefault(name, np.full(self.surface.shape, nothing, part.dtype))
                whole[
                    rows.start - self.rows.start : rows.stop - self.rows.start,
                    cols.start - self.cols.start : cols.stop - self.cols.start,
                ] = part
        return out

    def windows(self, job: SceneInputs) -> list[tuple[slice, slice]]:
        """Of the blocks of stage project, as far as they lie in this one, as the pair sees them."""
        return [
            (
                slice(r, min(r + SHARD, self.rows.stop)),
                job.pair.cols(slice(c, min(c + SHARD, self.cols.stop))),
            )
            for r in range(self.rows.start, self.rows.stop, SHARD)
            for c in range(self.cols.start, self.cols.stop, SHARD)
        ]
