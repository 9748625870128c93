"""A plane with or without a box on it: rectified images, points, exact disparity."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pyproj

from stereotruth.align.alignment import Alignment, ViewFit
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.products.grids import Layer, atomic_store, create_grid, open_grid
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest

from .cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES, camera
from .images import pattern
from .las import adjusted, write_las

SIZE = (320, 280)  # cols, rows of both original images
HALF = (16.0, 13.0)  # m east, north: half sides of the box
ROOF = HEIGHT + 30.0
UTM = pyproj.CRS("EPSG:32650").to_3d()


def model_of(left_angle: float = 90.0) -> EpipolarModel:
    left = camera(BACKWARD, angle=left_angle, size=SIZE)
    right = camera(FORWARD, angle=left_angle + 2.0, gsd=0.8, size=SIZE)
    return fit_epipolar(left, right, SIZE, SIZE, HEIGHT, height_range=(HEIGHT - 50, HEIGHT + 100))


def alignment_of(model: EpipolarModel, factor: float, worse: str = "left") -> Alignment:
    """Exact RPCs, known to ``factor`` times 0.04 px; those of one view half as well."""
    sigma = factor * np.array([0.01, 0.0, 0.04, 0.0, 0.01, 0.04])
    sensors = model.left, model.right
    fits = [
        ViewFit(
            view=view,
            image=f"{view}.tif",
            size=SIZE,
            affine=np.array(sensor.affine),
            gcps=(),
            sigma0=np.nan,
            redundancy=0,
            origin=(SIZE[0] / 2, SIZE[1] / 2),
            scale=100.0,
            covariance=np.diag(sigma) ** 2 * (4 if view == worse else 1),
        )
        for view, sensor in zip(("left", "right"), sensors)
    ]
    return Alignment("S-1", "affine", *sensors, *fits, HEIGHT, (), {})


def on_ground(sensor, col: np.ndarray, row: np.ndarray, height: float) -> np.ndarray:
    """[2, ...] east, north (m) of where rays meet a height; the cameras are affine."""
    lon, lat = sensor.localize(col, row, np.full(col.shape, height))
    return np.stack([(lon - LON) * METRES[0], (lat - LAT) * METRES[1]])


def seen(model: EpipolarModel, view: str, box: bool) -> tuple[np.ndarray, ...]:
    """East, north, height of the surface that every pixel of a rectified image shows."""
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(float)
    to_image, sensor = (
        (model.epipolar_to_left, model.left)
        if view == "left"
        else (model.epipolar_to_right, model.right)
    )
    col, row = to_image(x, y)
    low, high = on_ground(sensor, col, row, HEIGHT), on_ground(sensor, col, row, ROOF)
    east, north, height = *low, np.full(col.shape, np.nan)
    for h in np.linspace(ROOF, HEIGHT, 301) if box else [HEIGHT]:
        e, n = low + (high - low) * ((h - HEIGHT) / (ROOF - HEIGHT))
        hit = np.isnan(height)
        if h > HEIGHT:
            hit &= (abs(e) < HALF[0]) & (abs(n) < HALF[1])
        east[hit], north[hit], height[hit] = e[hit], n[hit], h
    return east, north, height


@cache
def surfaces_of(box: bool) -> tuple[EpipolarModel, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """The model, and what the left and the right rectified image show."""
    model = model_of()
    return model, seen(model, "left", box), seen(model, "right", box)


def image_of(surface: tuple[np.ndarray, ...]) -> np.ndarray:
    east, north, height = surface
    return np.round(pattern(east + 3.0 * height, north - 2.0 * height)).astype(np.uint16)


def write_image(path: Path, model: EpipolarModel, pixels: np.ndarray, **delivery: object) -> Path:
    """``delivery``: attributes, of what it says."""
    with atomic_store(path) as scratch:
        layer = Layer("uint16", 0, {"units": "1", "long_name": "image"})
        array = create_grid(
            scratch,
            model.shape,
            {"image": layer},
            chunk=256,
            shard=1024,
            attrs={
                "epipolar": model.to_dict(),
                "provenance": {"made": path.name},
                **delivery,
            },
        )["image"]
        array[:] = pixels
    return path


def points_on(box: bool, noise: float = 0.0, spacing: float = 0.4) -> np.ndarray:
    """lon, lat, height of points on the plane and the roof [n, 3]; none on walls.

    A jittered grid without a gap of a pixel.
    """
    rng = np.random.default_rng(0)
    east, north = np.mgrid[-115:115:spacing, -115:115:spacing].reshape(2, -1)
    east, north = np.stack([east, north]) + rng.uniform(-0.25, 0.25, (2, east.size)) * spacing
    height = np.full(east.size, HEIGHT)
    if box:
        height[(abs(east) < HALF[0]) & (abs(north) < HALF[1])] = ROOF
    height += rng.normal(0, noise, east.size)
    return np.column_stack([LON + east / METRES[0], LAT + north / METRES[1], height])


def write_points(
    folder: Path,
    points: np.ndarray,
    name: str = "points",
    day: int | np.ndarray | None = None,
    acquired: Sequence[str] = (),
) -> Path:
    """Their store; ``day``: since 1970-01-01, in GPS times; ``acquired``: by a catalogue."""
    to_utm = pyproj.Transformer.from_crs("EPSG:4979", UTM, always_xy=True)
    folder.mkdir(exist_ok=True)
    xyz = np.column_stack(to_utm.transform(*points.T))
    first = np.ones(len(xyz), np.uint8)  # returns: no order of points tells another surface
    times = {}
    if day is not None:
        times = {"gps_time": adjusted(day + np.zeros(len(xyz))), "absolute": True}
    write_las(folder / f"{name}.las", xyz=xyz, return_number=first, **times)
    ingest(folder / f"{name}.las", folder / f"{name}.points", acquired=acquired)
    return folder / f"{name}.points"


PAIR = ("view", "alignment", "surface")
RUN = ("code", "workers", "scheduler", "scene", "strip")


def project_with(left: Path, right: Path, stores: list[Path], out: Path, **options):
    """project_scene; ``options`` are its own, view, alignment and surface, and those of its
    settings."""
    run = {name: options.pop(name) for name in RUN if name in options}
    pair = {name: options.pop(name) for name in PAIR if name in options}
    inputs = SceneInputs.of(left, right, stores, LabelSettings(**options), **pair)
    if inputs.point_stores and inputs.surface is None:
        inputs = inputs.with_surface(out.parent / "surfaces")
    return project_scene(inputs, out, **{"code": "test", **run})


class Scene:
    """Rectified images and points of the plane, with or without the box."""

    def __init__(self, folder: Path, box: bool, **options: float) -> None:
        self.folder = folder
        self.model, *surfaces = surfaces_of(box)
        self.surface = surfaces[0]
        self.images = [
            write_image(folder / f"{view}.zarr", self.model, image_of(surface))
            for view, surface in zip(("left", "right"), surfaces)
        ]
        self.points = points_on(box, **options)
        self.store = write_points(folder, self.points)
        east, north, height = self.surface
        xy = self.model.ground_to_epipolar(LON + east / METRES[0], LAT + north / METRES[1], height)
        self.truth = (xy[0] - xy[2]).reshape(self.model.shape)

    def inputs(self, settings: LabelSettings, view: str = "left") -> SceneInputs:
        """What the scene's labels are made of."""
        inputs = SceneInputs.of(*self.images, [self.store], settings, view)
        return inputs.with_surface(self.folder / "surfaces")

    def project(self, name: str = "out.zarr", stores: list[Path] | None = None, **options):
        out = self.folder / name
        self.summary = project_with(*self.images, stores or [self.store], out, **options)
        return open_grid(out)


def hidden_truth(scene: Scene) -> np.ndarray:
    """Pixels of the left image whose surface the box hides from the right camera."""
    model = scene.model
    east, north, height = scene.surface
    lon, lat = LON + east / METRES[0], LAT + north / METRES[1]
    xy = model.ground_to_epipolar(lon, lat, height)
    col, row = model.epipolar_to_right(xy[2], xy[3])
    hidden = np.zeros(col.size, dtype=bool)
    low, high = (on_ground(model.right, col, row, h) for h in (HEIGHT, ROOF))
    for h in np.linspace(HEIGHT, ROOF, 301)[1:]:
        e, n = low + (high - low) * ((h - HEIGHT) / (ROOF - HEIGHT))
        inside = (np.abs(e) < HALF[0] - 1e-6) & (np.abs(n) < HALF[1] - 1e-6)
        hidden |= inside & (h > height.reshape(-1) + 0.11)
    return hidden.reshape(model.shape)


def dilated(mask: np.ndarray, by: int = 1) -> np.ndarray:
    padded = np.pad(mask, by)
    out = np.zeros_like(mask)
    for r in range(2 * by + 1):
        for c in range(2 * by + 1):
            out |= padded[r : r + mask.shape[0], c : c + mask.shape[1]]
    return out
