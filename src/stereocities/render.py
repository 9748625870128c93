"""Satellite images of a city: cameras of a scene, ray-cast pixels, GeoTIFF with RPCs."""

from __future__ import annotations

import logging
import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio

from stereotruth.core.errors import InputError
from stereotruth.core.job import progress
from stereotruth.core.kernels import inlined, kernel
from stereotruth.core.products.files import atomic_file

from .appearance import reflectance
from .camera import LocalFrame, Pass, aim, direction, jittering, pose, rays
from .cities import LEFT_GSD_M, RIGHT_GSD_M, CitySpec, SceneSpec, ViewSpec
from .layout import frame_of, half_size, scene_coordinates
from .rpcs import FittedRPC, draw_bias, fit_rpc, read_rpc, rpc_camera
from .surfaces import (
    LEFT_VIEW,
    NONE,
    RIGHT_VIEW,
    Surfaces,
    above_ground,
    direction_of_sun,
    ground_hit,
    horizon,
    terrain_heights,
)
from .world import surfaces_of, world_of

log = logging.getLogger("stereotruth")


FULL_SCALE = 2047  # 11 bits
FULL_SCALE_OF_8 = 255
STRIP_ROWS = 128
GUESS_ROWS = 8
RPC_MARGIN_M = 130.0
FRAME_PX = 30  # of a window of given RPCs around the place
SHOWN = {"left": LEFT_VIEW, "right": RIGHT_VIEW}
RADIOMETRY = {"left": (55.0, 1480.0), "right": (70.0, 1370.0)}  # dark value, DN per reflectance
LEFT_COLLAR, RIGHT_COLLAR = 1, 2  # see in_collar
COLLARS = {"left": LEFT_COLLAR, "right": RIGHT_COLLAR}
View = tuple[str, np.ndarray, int, int]  # an image's name, packed camera, columns and rows
NOISE_SEEDS = {"left": 1, "right": 0}


class Camera(NamedTuple):
    """One image: packed camera, its size, biased RPCs, horizon of its rays.

    ``name``: of the image, or of the view of a scene. ``surfaces``: the city's by the sun of the
    image; ``shown``: bits of the objects in it. ``collar``: see :func:`in_collar`. ``radiometry``:
    dark value and digital numbers per reflectance; ``noise_seed``: of the sensor noise. ``look``:
    point spread and grey levels.
    """

    name: str
    cam: np.ndarray
    cols: int
    rows: int
    rpc: FittedRPC
    horizon: np.ndarray
    surfaces: Surfaces
    shown: int
    collar: int
    radiometry: tuple[float, float]
    noise_seed: int
    look: ViewSpec = ViewSpec()

    @property
    def sight(self) -> Sight:
        """What kernels need of it."""
        return Sight(
            self.surfaces, self.horizon, self.shown, self.cam, self.collar, self.cols, self.rows
        )


class Sight(NamedTuple):
    """An image for kernels: its world, horizon (``above``), bits shown, camera, collar and size."""

    surfaces: Surfaces
    above: np.ndarray
    shown: int
    cam: np.ndarray
    collar: int
    cols: int
    rows: int


class Relief(NamedTuple):
    """Heights of a scene, m above the frame's: lowest ground, middle of the ground, highest top."""

    low: float
    middle: float
    top: float


class ImagedScene(NamedTuple):
    """What every job on a scene starts from."""

    city: CitySpec
    spec: SceneSpec
    frame: LocalFrame
    surfaces: Surfaces
    left: Camera
    right: Camera


def prepare(city: CitySpec, scene: SceneSpec, built: str | Path | None = None) -> ImagedScene:
    """World and cameras of a scene; kept for further calls of the same process.

    ``built``: the city's surfaces in a file, see :func:`.world.surfaces_of`.
    """
    return _prepare(city, scene, None if built is None else Path(built))


@lru_cache(maxsize=4)
def _prepare(city: CitySpec, scene: SceneSpec, built: Path | None) -> ImagedScene:
    surfaces = surfaces_of(city, built)
    frame = frame_of(city)
    relief = relief_of(city, scene, surfaces)
    views = _by_rpcs(city, frame, relief) if city.twin and city.twin.rpcs else None
    cameras = []
    for view, cam, cols, rows in views or _on_a_pass(scene, frame, relief):
        rpc = biased_rpc(cam, frame, relief, (cols, rows), (scene.pose_seed, view))
        look = getattr(city, view)
        if look.jitter:  # the RPCs know nothing of it
            drawn = np.random.default_rng([scene.pose_seed, 6 if view == "left" else 7])
            cam = jittering(cam, look.jitter, drawn)
        own = by_sun_of(world_of(city, surfaces, view), look.sun_deg)
        cameras.append(
            Camera(
                view, cam, cols, rows, rpc, horizon_of(cam, cols, rows, surfaces), own,
                SHOWN[view], COLLARS[view], RADIOMETRY[view], NOISE_SEEDS[view], look,
            )
        )  # fmt: skip
    return ImagedScene(city, scene, frame, surfaces, *cameras)


def _on_a_pass(scene: SceneSpec, frame: LocalFrame, relief: Relief) -> list[View]:
    """Both images of a scene as GaoFen-7 takes them on one pass."""
    target = np.array([*scene.centre_m, relief.middle])
    # the forward view takes in all that the backward view shows, however high it stands
    rise = max(relief.top - relief.middle, relief.middle - relief.low)
    lean = rise * math.tan(math.radians(29)) + 45
    right_cols = math.ceil(scene.cols * LEFT_GSD_M / RIGHT_GSD_M + 2 * 60 + 0.02 * scene.rows)
    right_rows = math.ceil(
        scene.rows * LEFT_GSD_M / RIGHT_GSD_M + 2 * lean / RIGHT_GSD_M + 0.02 * scene.cols
    )
    views = []
    for view, gsd, cols, rows in (
        ("left", LEFT_GSD_M, scene.cols, scene.rows),
        ("right", RIGHT_GSD_M, right_cols, right_rows),
    ):
        flown = Pass.drawn(view, scene.pose_seed, ascending=scene.ascending)
        cam = aim(frame, target, flown, gsd=gsd, cols=cols, rows=rows)
        views.append((view, cam, cols, rows))
    return views


def _by_rpcs(city: CitySpec, frame: LocalFrame, relief: Relief) -> list[View]:
    """Both images of a twin as given RPCs see its place: the windows of them that show it."""
    (half_x, half_y), turned = city.twin.half_m, city.twin.turned_rad
    turn = np.array([[math.cos(turned), -math.sin(turned)], [math.sin(turned), math.cos(turned)]])
    corners = np.array([
        [*(turn @ [i * half_x, j * half_y]), z]
        for i in (-1, 1) for j in (-1, 1) for z in (relief.low, relief.top)
    ])  # fmt: skip
    ground = frame.to_geodetic(corners)
    heights = frame.height + relief.low - RPC_MARGIN_M, frame.height + relief.top + RPC_MARGIN_M
    views = []
    for view, file in zip(SHOWN, city.twin.rpcs):
        rpc = read_rpc(file).over(city.lon, city.lat, frame.height + relief.middle)
        image = rpc.project(ground)
        first = np.floor(image.min(axis=0)).astype(int) - FRAME_PX
        cols, rows = (np.ceil(image.max(axis=0)).astype(int) + FRAME_PX - first).tolist()
        cam = rpc_camera(rpc.cropped(*first.tolist()), frame, (cols, rows), heights)
        views.append((view, cam, cols, rows))
    return views


def relief_of(city: CitySpec, scene: SceneSpec, surfaces: Surfaces) -> Relief:
    """Heights of the ground that the left image can show, and of what stands there."""
    ny, nx = surfaces.cell_top.shape
    xx, yy = np.meshgrid(
        surfaces.x0 + 20 + 20 * np.arange(int(nx * 8 / 20) - 1),
        surfaces.y0 + 20 + 20 * np.arange(int(ny * 8 / 20) - 1),
    )
    xy = np.column_stack([xx.ravel(), yy.ravel()])
    local = np.abs(scene_coordinates(city, scene, xy)) < half_size(scene) + 100
    z = np.maximum(terrain_heights(surfaces, xy[local.all(axis=1)])[:, 0], surfaces.water)
    low, high = float(z.min()), float(z.max())
    objects = np.concatenate([[high], surfaces.boxes[:, 6] + surfaces.boxes[:, 7]])
    if len(surfaces.boxes):
        near = scene_coordinates(city, scene, surfaces.boxes[:, :2])
        inside = (np.abs(near) < half_size(scene) + 100).all(axis=1)
        objects = objects[np.append(True, inside)]
    if surfaces.patches.size:
        objects = np.append(objects, surfaces.cell_top.max())
    return Relief(low, (low + high) / 2, float(objects.max()))


def biased_rpc(
    cam: np.ndarray,
    frame: LocalFrame,
    relief: Relief,
    size: tuple[int, int],
    drawn: tuple[int, str],
    *,
    margin_m: float = RPC_MARGIN_M,
) -> FittedRPC:
    """The RPCs of a camera of an image of ``size`` (cols, rows), by a bias as ``drawn``.

    They hold ``margin_m`` above and below all that stands there. ``drawn``: seed and view of
    :func:`.rpcs.draw_bias`. Raises RuntimeError if the RPCs cannot follow the camera.
    """
    cols, rows = size
    heights = (
        frame.height + relief.low - margin_m,
        frame.height + relief.top + margin_m,
    )
    bias = draw_bias(cols, rows, *drawn)
    rpc = fit_rpc(cam, frame, cols=cols, rows=rows, heights=heights, bias=bias)
    if rpc.rms_px > 0.01:
        raise RuntimeError(f"RPCs of seed {drawn} miss the camera by {rpc.rms_px:.3f} px")
    return rpc


def horizon_of(cam: np.ndarray, cols: int, rows: int, surfaces: Surfaces) -> np.ndarray:
    """The horizon toward a camera, of the ray in the middle of its image."""
    _, toward = rays(cam, [[(cols - 1) / 2, (rows - 1) / 2]])
    return horizon(surfaces.cell_top, toward[0, 0], toward[0, 1])


def by_sun_of(surfaces: Surfaces, sun_deg: tuple[float, float] | None) -> Surfaces:
    """A city's surfaces by a sun of an azimuth and elevation; None: by the city's own."""
    if sun_deg is None:
        return surfaces
    sun = direction_of_sun(*sun_deg)
    top = horizon(surfaces.cell_top, sun[0] / sun[2], sun[1] / sun[2])
    return surfaces._replace(sun=sun, sun_top=top)


@inlined
def in_collar(collar, col, row, cols, rows):
    """Whether an image position lies in the strip without data along the frame.

    LEFT_COLLAR: wedges along the first rows and last columns, as in the left image of a pair;
    RIGHT_COLLAR: along the last rows and first columns.
    """
    if collar == LEFT_COLLAR:
        return (row < 3 + 14 * col / cols) | (col > cols - 4 - 9 * row / rows)
    return (row > rows - 5 - 12 * col / cols) | (col < 3 + 10 * row / rows)


@inlined
def has_data(image, col, row):
    """Whether a position lies in the frame of an image, outside its collar."""
    inside = col >= -0.5 and row >= -0.5 and col <= image.cols - 0.5 and row <= image.rows - 0.5
    return inside and not in_collar(image.collar, col, row, image.cols, image.rows)


@inlined
def ray(cam, line, col):
    """(ax, ay, bx, by) of the ray of a column of a line."""
    dx, dy, dz = direction(cam, line, col)
    bx, by = dx / dz, dy / dz
    return line[0] - bx * line[2], line[1] - by * line[2], bx, by


@kernel
def _shade_rows(s, above, shown, cam, first_row, out):
    """Reflectance on the half-pixel raster: out[2 r + a, 2 c + b] at (c, r) − 1/4 + (b, a)/2.

    ``shown``: bits of the objects seen. ``first_row`` is the image row of out's row 0; out's column
    0 is image column −2. Where the ground is follows from where it was a column before; at the
    first column, from where it was at the end of the row GUESS_ROWS before.
    """
    line = np.empty(12)
    last = np.zeros(GUESS_ROWS)
    sun = s.sun[0], s.sun[1], s.sun[2]
    for r in range(out.shape[0]):
        pose(cam, first_row - 0.25 + 0.5 * r, line)
        ground = last[r % GUESS_ROWS]
        before = ground
        for c in range(out.shape[1]):
            ax, ay, bx, by = ray(cam, line, -2.25 + 0.5 * c)
            guess = ground + (ground - before)  # the ground goes on as it did
            before = ground
            ground, zx, zy = ground_hit(s, ax, ay, bx, by, guess)
            z, kind, index, face = above_ground(s, above, ax, ay, bx, by, shown, True, ground)
            value = 0.1
            if kind != NONE:
                value = reflectance(
                    s, sun, shown, ax + bx * z, ay + by * z, z, kind, index, face, (zx, zy)
                )
            out[r, c] = value
        last[r % GUESS_ROWS] = ground


def _decimate(half: np.ndarray, psf_px: float) -> np.ndarray:
    """Pixels [r, c] from the half-pixel raster [2 (r + 4), 2 (c + 4)]: a Gaussian point spread."""
    offsets = np.arange(-2.75, 3.0, 0.5)[2:-2]  # ±0.25, 0.75, 1.25, 1.75
    weights = np.exp(-0.5 * (offsets / psf_px) ** 2).astype(np.float32)
    weights /= weights.sum()
    n = len(weights)
    start = 4 - (n // 2 - 1)
    size = half.shape[1] // 2 - 4
    across = sum(w * half[:, start + k : start + k + 2 * size : 2] for k, w in enumerate(weights))
    size = half.shape[0] // 2 - 4
    return sum(w * across[start + k : start + k + 2 * size : 2] for k, w in enumerate(weights))


def simulate_image(
    city: CitySpec,
    scene: SceneSpec,
    view: str,
    out_tif: str | Path,
    *,
    seed: int,
    built: str | Path | None = None,
) -> dict[str, float]:
    """Render the ``"left"`` (backward) or ``"right"`` (forward) image of a scene.

    Writes uint16 [rows, cols] of 11 bits (or 8, see :class:`.cities.ViewSpec`) with nodata 0 and
    the RPCs as TIFF metadata. ``seed`` draws the sensor noise only; ``built`` is that of
    :func:`prepare`. Returns the image size and how well the RPCs follow the camera (bias and jitter
    apart). Raises InputError for another view.
    """
    if view not in ("left", "right"):
        raise InputError(f"no view {view!r}", remedy="ask for left or right")
    ready = prepare(city, scene, built)
    return render(getattr(ready, view), f"{scene.name} {view}", out_tif, seed=seed)


def render(camera: Camera, name: str, out_tif: str | Path, *, seed: int) -> dict[str, float]:
    """Write what a camera shows; ``name`` is for the log. See :func:`simulate_image`."""
    log.info(
        "%s: %d x %d px; RPCs follow the camera within %.1e px rms (bias apart)",
        name, camera.cols, camera.rows, camera.rpc.rms_px,
    )  # fmt: skip
    dark, gain = camera.radiometry
    scale, full_scale = 1.0, FULL_SCALE
    if camera.look.saturates is not None:
        full_scale = FULL_SCALE_OF_8
        scale = full_scale / (dark + gain * camera.look.saturates)
    cols, rows = camera.cols, camera.rows
    profile = dict(
        driver="GTiff", width=cols, height=rows, count=1, dtype="uint16", nodata=0, tiled=True,
        blockxsize=256, blockysize=256, compress="deflate", predictor=2, zlevel=1,
        rpcs=camera.rpc.metadata,
    )  # fmt: skip
    col_index = np.arange(cols, dtype=np.float64)[None, :]
    strips = range(0, rows, STRIP_ROWS)
    with atomic_file(out_tif) as scratch:
        image = np.zeros((rows, cols), np.uint16)
        for first in progress(strips, len(strips), name):
            count = min(STRIP_ROWS, rows - first)
            half = np.empty((2 * (count + 4), 2 * (cols + 4)), np.float32)
            _shade_rows(
                camera.surfaces, camera.horizon, camera.shown, camera.cam, first - 2.0, half
            )
            signal = dark + gain * _decimate(half, camera.look.psf_px)
            rng = np.random.default_rng([seed, camera.noise_seed, first])
            noise = rng.standard_normal(signal.shape, dtype=np.float32)
            # read-out noise and shot noise: 3 DN at 100, 5 DN at 600
            signal += noise * np.sqrt(4.0 + 0.035 * signal)
            values = np.clip(np.rint(signal * scale), 1, full_scale).astype(np.uint16)
            row = np.arange(first, first + count, dtype=np.float64)[:, None]
            values[in_collar(camera.collar, col_index, row, cols, rows)] = 0
            image[first : first + count] = values
        with rasterio.open(scratch, "w", **profile) as target:
            target.write(image, 1)
            bits = full_scale.bit_length()
            target.set_band_description(1, f"panchromatic, {bits} bits")
    return {"cols": cols, "rows": rows, "rpc_rms_px": camera.rpc.rms_px}
