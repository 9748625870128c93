"""Stores of a scene with analytic cameras, terrain and texture, to be cut into tiles."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import rasterio

from stereotruth.core.config.configuration import Export, Limits
from stereotruth.core.products.grids import Layer, atomic_store, create_grid
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import COLOURS, EpipolarModel
from stereotruth.sensor.rpc import RPC, SensorModel
from stereotruth.tiles.export import Extras, export_city
from stereotruth.tiles.scene_stores import SceneFiles
from stereotruth.tiles.tile_files import City

SIZE = 64
PIXELS = 360  # side of the original images
FLAGS = ["no_points", "labelled", "hidden_in_left", "hidden_in_right", "low_correlation"]
LAT, LON = 30.2, 115.4
METRE_LAT = 1 / 111_000.0
METRE_LON = METRE_LAT / np.cos(np.radians(LAT))


def camera(lean: float, turn: float, metres_per_px: float) -> SensorModel:
    """Parallel camera that looks north, ``lean`` m of row shift per m of height, with some bend."""
    half = PIXELS / 2
    reach = half * 0.7
    zero = np.zeros(20)
    one = zero.copy()
    one[0] = 1.0
    samp, line = zero.copy(), zero.copy()
    samp[[1, 2, 3, 7]] = np.cos(turn), np.sin(turn), 0.002, 0.0005
    line[[1, 2, 3, 8]] = np.sin(turn), -np.cos(turn), lean * 60.0 / reach, 0.0004
    scale = reach / metres_per_px
    rpc = RPC(
        half, half, LAT, LON, 50.0,
        scale, scale, reach * METRE_LAT, reach * METRE_LON, 60.0,
        line, one, samp, one,
    )  # fmt: skip
    return SensorModel(rpc, np.array([[1.0, 1e-4, 3.25], [-2e-4, 1.0, -4.5]]))


def terrain(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    east, north = (lon - LON) / METRE_LON, (lat - LAT) / METRE_LAT
    return 40.0 + 12.0 * np.sin(east / 45.0) * np.cos(north / 60.0)


def texture(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    east, north = (lon - LON) / METRE_LON, (lat - LAT) / METRE_LAT
    waves = np.sin(east / 2.9) + np.sin(north / 3.7) + np.sin((east + 1.7 * north) / 6.1)
    return 500.0 + 120.0 * waves


def surface(sensor: SensorModel, col: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Ground point of each pixel's ray on the terrain, by fixed-point iteration.

    A step leaves a fifth of the error, at most: the slope of the terrain times that of the ray.
    """
    height = np.full(col.shape, 40.0)
    for _ in range(9):
        lon, lat = sensor.localize(col, row, height)
        height = terrain(lon, lat)
    return lon, lat, height


def rough(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """A texture that SIFT likes: waves of 3 to 8 m of all directions."""
    east, north = (lon - LON) / METRE_LON, (lat - LAT) / METRE_LAT
    rng = np.random.default_rng(11)
    grey = np.full(lon.shape, 2000.0)
    for _ in range(40):
        angle, length, phase = rng.uniform((0, 3, 0), (np.pi, 8, 2 * np.pi))
        grey += 70 * np.sin(
            2 * np.pi / length * (np.cos(angle) * east + np.sin(angle) * north) + phase
        )
    return grey


@cache
def geometry(turn: float, row_shift: float) -> tuple[EpipolarModel, list[tuple], np.ndarray]:
    """The model; what each view sees (inside, lon, lat, height); the disparity [h, w]."""
    left, right = camera(0.09, turn, 0.70), camera(-0.48, -0.03, 0.75)
    model = fit_epipolar(left, right, (PIXELS, PIXELS), (PIXELS, PIXELS), 40.0)
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(np.float64)
    views = []
    for to_sensor, sensor, shift in (
        (model.epipolar_to_left, left, 0.0),
        (model.epipolar_to_right, right, row_shift),
    ):
        col, row = to_sensor(x, y - shift)
        inside = (abs(col - PIXELS / 2) < PIXELS / 2) & (abs(row - PIXELS / 2) < PIXELS / 2)
        views.append((inside, *surface(sensor, col, row)))
    ground = model.ground_to_epipolar(*(values.ravel() for values in views[0][1:]))
    return model, views, (ground[0] - ground[2]).reshape(model.shape)


def make_scene(
    folder: Path,
    *,
    bare_from: int = 10**6,
    turn: float = 0.02,
    texture: Callable[[np.ndarray, np.ndarray], np.ndarray] = texture,
    label_offset: float = 0.0,
    row_shift: float = 0.0,
    colour: bool = False,
    lidar_days: tuple[int, int] = (0, 0),
    acquired: tuple[str | None, str | None] = (None, None),
) -> SceneFiles:
    """Stores of one scene; labels end at epipolar row ``bare_from``.

    Planted errors: of the labels (px), and of the right image's rows (px, down). ``colour``: with
    red, green and blue beside the grey images. ``lidar_days`` of labels left and right of the
    middle; ``acquired``: of both images, by their deliveries.
    """
    model, views, disparity = geometry(turn, row_shift)
    attrs = {"epipolar": model.to_dict(), "provenance": {"made": "by hand"}}
    layer = Layer("uint16", 0, {"units": "1", "long_name": "grey value"})
    layers = dict.fromkeys(("image", *(COLOURS if colour else ())), layer)
    for name, taken, (inside, lon, lat, _) in zip(("left", "right"), acquired, views):
        grey = np.where(inside, np.rint(texture(lon, lat)), 0).astype(np.uint16)
        told = attrs | {"acquired": taken}
        with atomic_store(folder / f"{name}.zarr") as path:
            array = create_grid(path, model.shape, layers, chunk=64, shard=128, attrs=told)
            array["image"][:] = grey
            for k, band in enumerate(COLOURS if colour else ()):
                array[band][:] = grey + np.uint16(300 * k) * (grey > 0)
    inside, _, _, height = views[0]
    y = np.arange(model.shape[0])[:, None]
    rng = np.random.default_rng(3)
    known = inside & (rng.random(model.shape) < 0.9) & (y < bare_from)
    meta = {"units": "px", "long_name": "test"}
    with atomic_store(folder / "scene.zarr") as path:
        arrays = create_grid(
            path,
            model.shape,
            {
                "disparity": Layer("float32", np.nan, meta),
                "height": Layer("float32", np.nan, meta | {"units": "m"}),
                "lidar_date": Layer("uint16", 0, meta | {"units": "days since 1970-01-01"}),
                "status": Layer(
                    "uint8",
                    0,
                    meta | {"flag_values": list(range(5)), "flag_meanings": " ".join(FLAGS)},
                ),
            },
            chunk=64,
            shard=128,
            attrs=attrs,
        )
        arrays["disparity"][:] = np.where(known, disparity + label_offset, np.nan)
        arrays["height"][:] = np.where(known, height, np.nan)
        west = np.arange(model.shape[1]) < model.shape[1] // 2
        arrays["lidar_date"][:] = np.where(known, np.where(west, *lidar_days), 0)
        arrays["status"][:] = np.where(known, 1, np.where(inside & (y < bare_from), 4, 0))
    stores = (folder / f"{name}.zarr" for name in ("scene", "left", "right"))
    return SceneFiles(folder.name, *stores)


def alignment_notes(*gcp_rms_px: float, warnings: Sequence[str] = ()) -> SimpleNamespace:
    """What an alignment says of labels: residuals of both views, warnings."""
    fits = [SimpleNamespace(rms={"after": rms}.get) for rms in gcp_rms_px]
    return SimpleNamespace(fits=fits, warnings=warnings, refinement={})


NO_LIMITS = Limits(**dict.fromkeys(Limits.model_fields))
TOWN = City("Town", "TN", training=600, validation=80, testing=200)


def run(scenes, out: Path, **options) -> dict:
    """Export with other settings than the configuration's; ``options``: settings and the rest."""
    given = {"size": SIZE, "min_labelled": 0.6, "quality": NO_LIMITS, "seed": 1} | options
    known = Export.model_fields
    settings = {name: given.pop(name) for name in list(given) if name in known}
    city = {name: given.pop(name) for name in list(given) if name in TOWN.__dataclass_fields__}
    extras = {n: given.pop(n) for n in list(given) if n in Extras.__dataclass_fields__}
    return export_city(
        replace(TOWN, **city), scenes, out, Export(**settings), extras=Extras(**extras), **given
    )


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "manifest.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def read(path: Path) -> np.ndarray:
    with rasterio.open(path) as dataset:
        return dataset.read(1)


def labels(path: Path) -> np.ndarray:
    values = read(path).astype(np.float64)
    return np.where(values == -999, np.nan, values)
