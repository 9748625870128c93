"""Points to disparity: the stage `project` (paper, section III-C).

Every point is projected into both rectified images, and a pixel of the left epipolar grid has the
label d = x_left - x_right (px) of what it shows, by one of two recipes (``project.recipe``): see
:mod:`.label_window` and :mod:`.paper_recipe`. A point belongs to the pixel (floor(x_left + 0.5),
floor(y_left + 0.5)). The right image's labels are those of the mirrored pair, see
:mod:`.right_view`.

The grid is worked on in blocks of one shard, each independent of the others; a block is cut into
windows of a bounded number of points. The result has the same bytes for any number of workers, size
of windows, and order of blocks, stores and points.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import dask
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..job import block_progress
from ..products.grids import Strip, blocks, require_complete
from ..products.provenance import checksums, describe, digest
from ..products.resumable_grids import BlockStore, making
from .image_patches import MaskedImage
from .label_window import label_window
from .layers import layers
from .overlap_check import apart, refuse_apart
from .rays import CELL_PX
from .scene_inputs import SceneInputs
from .settings import Settings
from .status import Status, is_labelled

log = logging.getLogger("stereotruth")


CHUNK = 256
SHARD = 1024
MAX_POINTS = 6_000_000  # expected in a window; some 60 bytes each at the peak


ENOUGH = 80.0  # % of the pixels with a point: below, a warning says how to have more labels


def _tell_density(inputs: SceneInputs) -> None:
    """Log how dense the points are, and what that leaves without a label."""
    pixel = inputs.rays.cell_m / CELL_PX
    per_px = inputs.points_per_m2 * pixel**2
    share = 100.0 * (1.0 - np.exp(-per_px))  # of points strewn at random
    said = f"about {inputs.points_per_m2:.2g} LiDAR points per m², pixels of {pixel:.2g} m"
    if inputs.settings.on_surface or share > ENOUGH:
        log.info("%s", said)
        return
    log.warning(
        "%s: a point falls into %.0f %% of the pixels, and the others get no label. "
        "project.recipe: surface labels pixels between points, too",
        said,
        share,
    )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Makes the blocks (rows, cols) of a view's grid; plain values, for other processes."""

    scene: SceneInputs
    max_points: int

    def key(self, content: str, rows: slice, cols: slice) -> str:
        """Digest of all that the labels of a block follow from: ``content`` and its points."""
        touched = self.scene.windows.touched(rows, self.scene.pair.cols(cols))
        points = sorted(_identity(store.attrs) for store in touched)
        return digest({"content": content, "points": points})

    def make(self, out: BlockStore, key: str, rows: slice, cols: slice) -> None:
        """Label one block and write it, with its pixels by status and counts of points.

        Nothing, if it is there: a Dask worker that is lost takes with it that it had written it.
        """
        if out.has((rows, cols), key):
            return
        here = self.scene.pair.cols(cols)
        shape = rows.stop - rows.start, cols.stop - cols.start
        fill = layers(self.scene.settings, self.scene.view, self.scene.has_masks)
        arrays: dict[str, NDArray] = {}
        points = np.zeros(3, dtype=np.int64)
        for r, c in self.scene.windows.parts(rows, here, self.max_points):
            found = label_window(self.scene, r, c)
            if found is None:
                continue
            part = (
                slice(r.start - rows.start, r.stop - rows.start),
                slice(c.start - here.start, c.stop - here.start),
            )
            for name, layer in found[0].items():
                if name not in arrays:
                    arrays[name] = np.full(shape, fill[name].fill, dtype=layer.dtype)
                arrays[name][part] = layer
            points += found[1]
        image = self.scene.pair.images[0]
        if isinstance(image, MaskedImage) and (masked := image.mask[rows, here] != 0).any():
            arrays.setdefault("status", np.full(shape, fill["status"].fill, np.uint8))
            for name, array in arrays.items():
                array[masked] = Status.MASKED if name == "status" else fill[name].fill
        arrays = self.scene.pair.arrays(arrays)
        status = arrays.get("status", np.zeros(shape, dtype=np.uint8))
        counts = np.bincount(status.reshape(-1), minlength=len(Status))
        out.write((rows, cols), key, arrays, [*counts.tolist(), *points.tolist()])


def _identity(attrs: Mapping[str, Any]) -> str:
    """What stands for the values of a store; something new each time if it does not tell."""
    made_of = attrs.get("provenance") or {"unknown": os.urandom(8).hex()}
    return attrs.get("content") or digest(made_of)


def project_scene(
    left_store: str | Path,
    right_store: str | Path,
    point_stores: Sequence[str | Path],
    out: str | Path,
    settings: Settings,
    *,
    code: str,
    alignment: str | Path | None = None,
    view: str = "left",
    workers: int = 1,
    scheduler: Any = "threads",
    scene: str = "",
    max_points: int = MAX_POINTS,
    strip: Strip | None = None,
) -> dict[str, Any] | None:
    """Project the points of a scene and write its disparity grid; returns the summary.

    ``left_store``, ``right_store``: rectified images made by `rectify`; ``point_stores``: made by
    `ingest`, in any order. ``alignment``: the JSON file that the images were rectified with, whose
    covariance enters the labels' uncertainty; without it, it counts as exact. ``view``: left, or
    right for the labels of the right image, on its own grid of the same shape. ``code``: digest of
    the source, for the provenance. ``scheduler`` is what Dask's compute takes; ``workers`` the
    number of its threads.

    Blocks that an earlier call has left, made of the same, are taken over (see
    :mod:`stereotruth.products.resumable_grids`). ``strip``: make its blocks only, for a later call
    without it, and return None.

    The store [y, x] on the epipolar grid of the view: see :func:`.layers.layers`; attributes
    ``epipolar`` (the model), ``view``, ``summary``, ``points_bounds``, ``alignment_sigma_px``
    (standard uncertainty of a ground point's disparity, x and y: medians), ``provenance``. Summary:
    ``pixels`` by status, ``points`` (in the grid, in both frames, used), ``labelled_share`` of the
    pixels that have points.

    Raises InputError if no point falls into both images.
    """
    # Absolute, since workers of a Dask cluster live in other folders.
    left_store, right_store, out = (Path(p).absolute() for p in (left_store, right_store, out))
    paths = sorted(Path(path).absolute() for path in point_stores)
    if not paths:
        raise InputError("no point store", file=out, remedy="give the scene's LiDAR files")
    aligned = None if alignment is None else Path(alignment).absolute()
    inputs = SceneInputs(left_store, right_store, tuple(paths), settings, view, aligned)
    shape, stores = inputs.pair.model.shape, inputs.stores
    corners = np.array([store.bounds for store in stores])
    bounds = [*corners[:, :2].min(0), *corners[:, 2:4].max(0)]
    heights = float(corners[:, 4].min()), float(corners[:, 5].max())
    points_bounds = [float(value) for value in (*bounds, *heights)]
    images = inputs.windows.ground_box(slice(0, shape[0]), slice(0, shape[1]), *heights)
    where = stores[0].path.parent
    if images is None:
        raise InputError(
            "the epipolar model reaches no ground", file=left_store, remedy="run rectify again"
        )
    if apart(tuple(bounds), images):
        refuse_apart(tuple(bounds), images, heights, where)
    left_attrs, right_attrs = (require_complete(p).attrs for p in (left_store, right_store))
    told = {"left": left_attrs, "right": right_attrs}
    told |= {f"points/{store.path.name}": store.attrs for store in stores}
    made_of = {name: digest(dict(attrs.get("provenance", {}))) for name, attrs in told.items()}
    if aligned is not None:
        made_of |= checksums([aligned])
    parameters = {"view": view} | asdict(settings)
    attrs = {
        "kind": "disparity",
        "scene": scene,
        "view": view,
        "epipolar": dict(left_attrs["epipolar"]),
        "points_bounds": points_bounds,
        "alignment_sigma_px": inputs.pair.uncertainty.sigma,
        "points_per_m2": round(inputs.points_per_m2, 4),
        "points_per_px": round(inputs.points_per_m2 * (inputs.rays.cell_m / CELL_PX) ** 2, 4),
        "points_bounds_order": "lon_min, lat_min, lon_max, lat_max (degrees), "
        "height_min, height_max (m, ellipsoidal)",
        "settings": parameters,
        "provenance": describe(made_of, parameters, code),
    }
    _tell_density(inputs)
    content = digest(
        {
            "images": [_identity(left_attrs), _identity(right_attrs)],
            "epipolar": left_attrs["epipolar"],
            "uncertainty": inputs.pair.uncertainty.content,
            "parameters": parameters
            | ({"scale": asdict(inputs.scale)} if settings.on_surface else {}),
            "code": code,
        }
    )
    job = _Blocks(inputs, max_points)
    grid = making(
        out,
        shape,
        layers(settings, view, inputs.has_masks),
        chunk=CHUNK,
        shard=SHARD,
        shared=strip is not None,
    )
    with grid as unfinished:
        every = blocks(shape, SHARD)
        part = every if strip is None else strip.of(every)
        keys = [job.key(content, *block) for block in part]
        tasks = [
            dask.delayed(job.make, pure=False)(
                unfinished, keys[number], *part[number], dask_key_name=f"block-{number:07d}"
            )
            for number in unfinished.missing(part, keys, workers)
        ]
        with block_progress(len(tasks), "disparity"):
            dask.compute(*tasks, scheduler=scheduler, num_workers=workers)
        if strip is not None:
            return None
        counts = np.sum(unfinished.results(every), axis=0).tolist()
        pixels = {status.name.lower(): counts[status] for status in inputs.statuses}
        in_grid, framed, used = counts[len(Status) :]
        if framed == 0:
            refuse_apart(tuple(bounds), images, heights, where)
        beyond = "no_points", "out_of_frame", "masked"
        reached = sum(n for name, n in pixels.items() if name not in beyond)
        labelled = sum(counts[status] for status in inputs.statuses if is_labelled(status))
        summary = {
            "pixels": pixels,
            "points": {"in_grid": in_grid, "in_frame": framed, "used": used},
            "labelled_share": round(labelled / max(reached, 1), 6),
        }
        unfinished.publish(out, every, attrs | {"summary": summary})
    log.info(
        "%s: %d pixels labelled, %.1f %% of those with points in both images (%s)",
        settings.recipe,
        labelled,
        100.0 * summary["labelled_share"],
        ", ".join(f"{name} {n}" for name, n in pixels.items() if n and name != "labelled"),
    )
    if summary["labelled_share"] < 0.4:
        log.warning(
            "only %.0f %% of the pixels with points are seen alike in both images: check the "
            "vertical datum of the LiDAR (geoid in scenes.tsv), its CRS and the GCP residuals",
            100.0 * summary["labelled_share"],
        )
    return summary
