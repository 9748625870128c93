"""Resampling of a stereo pair into epipolar images: [y, x] Zarr grids of uint16, nodata 0.

Both images of a pair get the same grid and pixel size, so that rows correspond and
d = x_left - x_right is in px of that grid. The geometry is :mod:`stereotruth.epipolar.fit`'s.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask.threaded
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job import block_progress
from ..core.numerics.arrays import Floats
from ..core.numerics.interpolation import SIX_POINT_RADIUS
from ..core.products.grids import Layer, Strip, blocks
from ..core.products.provenance import digest, file_sha256, source_digest
from ..core.products.resumable_grids import BlockStore, resumable_grid
from ..sensor.deliveries import read_acquisition
from ..sensor.images import Source
from ..sensor.rpc import SensorModel
from .intersection import coarse_place
from .model import COLOURS, EpipolarModel, ImageModel
from .resampling import ANTIALIAS, KERNEL, resample

log = logging.getLogger("stereotruth")


SHARD = 1024  # px; one task writes one shard file
CHUNK = 256
LATTICE = 16  # px between exact source coordinates; in between they are bilinear
LATTICE_ERROR = 0.002  # px, accepted error of that
MASK = {
    "units": "1",
    "long_name": "what a mask hides",
    "flag_values": [0, 1],
    "flag_meanings": "seen masked",
}


def _lattice_step(model: ImageModel, shape: tuple[int, int]) -> tuple[int, float]:
    """Lattice spacing in px that keeps the error of bilinear coordinates small, and that error.

    The error, in source px, is taken at the middle of lattice cells all over the grid.
    """
    for step in (LATTICE, LATTICE // 2, LATTICE // 4, 1):
        y = np.linspace(0, shape[0] - 1, 33)[:, None]
        x = np.linspace(0, shape[1] - 1, 33)[None, :]
        corners = [
            np.stack(model.inverse(x + a * step, y + b * step)) for a in (0, 1) for b in (0, 1)
        ]
        exact = np.stack(model.inverse(x + step / 2, y + step / 2))
        error = float(np.nanmax(np.abs(sum(corners) / 4 - exact)))
        if error <= LATTICE_ERROR or step == 1:
            break
    return step, error


def _widening(model: ImageModel, shape: tuple[int, int]) -> tuple[float, float]:
    """Source px per epipolar px along (col, row), mid-grid, if above ANTIALIAS; else 1."""
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    col, row = model.inverse([x - 1, x + 1, x, x], [y, y, y - 1, y + 1])
    spans = [float(np.hypot(c[1] - c[0], c[3] - c[2]) / 2) for c in (col, row)]
    return tuple(span if span > ANTIALIAS else 1.0 for span in spans)


def _touched(
    masked: NDArray[np.bool_],
    lattice: Floats,
    step: int,
    scale: tuple[float, float],
    shape: tuple[int, int],
) -> NDArray[np.uint8]:
    """1 where a pixel of the image would be made of masked ones, too; 0 outside the image."""
    everywhere, beside = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    resample(np.ones(masked.shape, np.float32), lattice, step, scale, everywhere)
    there = np.where(masked, np.float32(np.nan), np.float32(1))
    resample(there, lattice, step, scale, beside)
    return ((everywhere > 0) & (beside == 0)).astype(np.uint8)


def rectify_image(
    source: Source,
    model: ImageModel,
    target: BlockStore,
    shape: tuple[int, int],
    *,
    key: str,
    workers: int,
    what: str = "rectified image",
    strip: Strip | None = None,
) -> dict[str, Any]:
    """Resample one image into its epipolar grid, block by block; returns facts for the attributes.

    A task reads the window of the source that its block needs; the result does not depend on
    ``workers`` or on the order of the tasks. Blocks that are there with the same ``key`` are taken
    over. ``strip``: only its blocks.

    Raises InputError if no pixel of the whole grid gets a value.
    """
    step, error = _lattice_step(model, shape)
    scale = _widening(model, shape)
    reach = [int(np.ceil(SIX_POINT_RADIUS * s)) + 1 for s in scale]
    names = ("image", *(COLOURS if source.colour else ()))

    def window(rows: slice, cols: slice) -> tuple[Floats, list[int]] | None:
        """Source (col, row) [2, k, l] at every ``step``-th pixel of a block and past it, and the
        part of the source that these need; None beside it."""
        y = np.arange(rows.start, rows.stop + step, step, dtype=np.float64)
        x = np.arange(cols.start, cols.stop + step, step, dtype=np.float64)
        lattice = np.stack(model.inverse(x[None, :], y[:, None]))
        bounds = []
        for axis in range(2):
            if not np.isfinite(lattice[axis]).any():
                return None
            low = int(np.floor(np.nanmin(lattice[axis]))) - reach[axis]
            high = int(np.ceil(np.nanmax(lattice[axis]))) + reach[axis] + 1
            low, high = max(low, 0), min(high, source.size[axis])
            if low >= high:
                return None
            bounds += [low, high - low]
        return lattice, bounds

    def run(rows: slice, cols: slice) -> None:
        found = window(rows, cols)
        if found is None:
            target.write((rows, cols), key, {}, 0)
            return
        lattice, (col, width, row, height) = found
        layers, masked = source.read_layers(col, row, width, height)
        lattice[0] -= col
        lattice[1] -= row
        shape = rows.stop - rows.start, cols.stop - cols.start
        arrays = {name: np.zeros(shape, dtype=np.uint16) for name in names}
        valid, *_ = (
            resample(pixels, lattice, step, scale, out)
            for pixels, out in zip(layers, arrays.values())
        )
        if masked.any():
            arrays["mask"] = _touched(masked, lattice, step, scale, shape)
        target.write((rows, cols), key, arrays, valid)

    every = blocks(shape, SHARD)
    part = every if strip is None else strip.of(every)
    # In the order of source rows, so that GDAL's cache serves neighbours in files of strips.
    todo = []
    for number in target.missing(part, [key] * len(part), workers):
        rows, cols = part[number]
        middle = model.inverse((cols.start + cols.stop) / 2, (rows.start + rows.stop) / 2)
        todo.append((float(np.nan_to_num(middle[1])) // SHARD, rows, cols))
    todo.sort(key=lambda item: item[0])
    tasks = [
        dask.delayed(run)(rows, cols, dask_key_name=f"block-{i:07d}")
        for i, (_, rows, cols) in enumerate(todo)
    ]
    with block_progress(len(tasks), what):
        dask.compute(*tasks, scheduler=dask.threaded.get, num_workers=workers)
    if strip is not None:
        return {}
    valid = int(sum(target.results(every)))
    if valid == 0:
        raise InputError(
            "image has nothing but nodata where the two images overlap",
            file=source.path,
            remedy=f"check the image (its nodata value is {source.nodata}) and its RPC",
        )
    log.info("%s: %.1f %% of the grid has a value", what, 100.0 * valid / (shape[0] * shape[1]))
    bands = {}
    if source.band_count > 1:
        mix = {f"band {band}": round(weight, 6) for band, weight in source.mix.items()}
        bands = {"mix": mix, "colour": [f"band {band}" for band in source.colour]}
    return bands | {
        "source": source.path.name,
        "source_nodata": source.nodata,
        "value_gain": source.gain,
        "kernel": KERNEL,
        "kernel_widening_col_row": list(scale),
        "coordinate_error_px": round(error, 7),
        "valid_pixels": valid,
    }


def _of_delivery(source: Source, sensor: SensorModel) -> dict[str, Any]:
    """When an image was ``acquired`` (ISO day, UTC) and ``taken`` (ISO time, UTC), and the ``sun``
    (azimuth, elevation, degrees), by its delivery; None: not told."""
    place = float(sensor.rpc.long_off), float(sensor.rpc.lat_off)
    delivery = read_acquisition(source.path, place)
    time = delivery.time
    day, taken = (None, None) if time is None else (time.date().isoformat(), time.isoformat())
    sun = None if delivery.sun is None else [round(angle, 4) for angle in delivery.sun]
    return {"acquired": day, "taken": taken, "sun": sun}


def rectify(
    left: Source,
    right: Source,
    model: EpipolarModel,
    epipolar_json: str | Path | None,
    left_store: str | Path,
    right_store: str | Path,
    *,
    workers: int = 1,
    provenance: Mapping[str, Any] | None = None,
    strip: Strip | None = None,
) -> None:
    """Resample both images of a pair into the Zarr grids of its epipolar model.

    Grids hold ``image`` uint16 [y, x], 0 where there is no value; of images in colour ``red``,
    ``green`` and ``blue`` likewise, and of images with a mask ``mask`` uint8 [y, x], 1 where it
    hides the image; their attributes carry the model and ``provenance``. ``epipolar_json``: where
    the model goes. All three products appear when they are whole, or not at all.

    Blocks that an earlier call has left, made of the same images by the same model and code, are
    taken over (see :mod:`stereotruth.core.products.resumable_grids`). ``strip``: make its blocks
    only, for a later call without it.

    Raises InputError for images that cannot be read or hold nothing but nodata.
    """
    code = source_digest("stereotruth.epipolar.rectify")
    with ExitStack() as stack:
        finished = []
        for view, source, image, store in (
            ("left", left, model.left_image, left_store),
            ("right", right, model.right_image, right_store),
        ):
            layers = {
                "image": Layer(
                    dtype="uint16",
                    fill=0,
                    attrs={
                        "units": "1",
                        "long_name": f"digital numbers of the {view} epipolar image",
                        "nodata": 0,
                    },
                )
            }
            if source.colour:
                for name in COLOURS:
                    said = {"long_name": f"{name} of the {view} epipolar image"}
                    layers[name] = replace(layers["image"], attrs=layers["image"].attrs | said)
            if source.masks:
                layers["mask"] = Layer("uint8", 0, MASK | {"of": f"the {view} epipolar image"})
            attrs = {
                "view": view,
                "epipolar": model.to_dict(),
                **coarse_place(model, view),
                "provenance": dict(provenance or {}),
            } | _of_delivery(source, getattr(model, view))
            source.check_blocks(workers)
            grid = stack.enter_context(
                resumable_grid(
                    store,
                    model.shape,
                    layers,
                    chunk=CHUNK,
                    shard=SHARD,
                    shared=strip is not None,
                )
            )
            made_of = {
                "image": file_sha256(source.path),
                "size": source.size,
                "bands": [source.mix, source.colour],
                "model": image.to_dict(),
                "code": code,
            }
            if source.mask_path is not None:
                made_of["mask"] = file_sha256(source.mask_path)
            facts = rectify_image(
                source,
                image,
                grid,
                model.shape,
                key=digest(made_of),
                workers=workers,
                what=f"{view} epipolar image",
                strip=strip,
            )
            if strip is None:
                attrs["resampling"] = facts
                finished.append((grid, store, attrs))
        for grid, store, attrs in finished:
            grid.write_atomically(store, blocks(model.shape, SHARD), attrs)
        if strip is None and epipolar_json is not None:
            model.save(epipolar_json, provenance)
