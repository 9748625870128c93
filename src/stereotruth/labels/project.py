"""Points to disparity: the stage `project` (paper, section III-C).

Every point is projected into both rectified images, and a pixel of the left epipolar grid has the
label d = x_left - x_right (px) of what it shows, by one of two recipes (``project.recipe``): see
:mod:`.recipe` and :mod:`.paper_recipe`. A point belongs to the pixel (floor(x_left + 0.5),
floor(y_left + 0.5)). The right image's labels are those of the mirrored pair, see
:mod:`.view_geometry`.

The grid is worked on in blocks of one shard: what the LiDAR decides of each, then what the images
tell of it by the labels of this block and those beside it. The result has the same bytes for any
number of workers and order of blocks, stores and points.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, NoReturn

import dask.threaded
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job import block_progress
from ..core.products.grids import Strip, blocks, require_complete
from ..core.products.making import refuse_replaced
from ..core.products.provenance import checksums, describe, digest
from ..core.products.resumable_grids import Block, BlockStore, Ledger, resumable_grid
from ..core.status import Status, carries_label, is_labelled
from ..epipolar.intersection import coarse_place
from ..epipolar.model import EpipolarModel
from ..lidar.lattice import apart, refuse_apart
from .change_evidence import Evidence
from .layers import LidarLabels, layers
from .pair_window import MaskedImage
from .recipe import image_layers, label_window, lidar_labels
from .scene_inputs import SceneInputs, lidar_read

log = logging.getLogger("stereotruth")


CHUNK = 256
SHARD = 1024
MAKES_LAYERS = "block"  # begins the names of such tasks


LEAST_LABELLED = 0.4  # of the pixels with points: below, a warning says what to check
# Of a block: points in the grid, in both frames, used; and of the recipe surface pixels of which
# the images were asked, and of these the ones beyond what was learned by each figure.
COUNTED = "in_grid", "in_frame", "used", "asked", *Evidence._fields
# Share of the pixels that are asked which lies beyond what was learned by a figure of the evidence:
# no simulated city and no real scene of those that trees are fitted to has more than 11 %.
FAR_BEYOND = 0.15
ENOUGH = 80.0  # % of the pixels with a point: below, a warning says how to have more labels


def _log_density(inputs: SceneInputs) -> None:
    """Log how dense the points are, and what that leaves without a label."""
    pixel = inputs.rays.pixel_m
    per_px = inputs.points_per_m2 * pixel**2
    share = 100.0 * (1.0 - np.exp(-per_px))  # of points strewn at random
    density = f"about {inputs.points_per_m2:.2g} LiDAR points per m², pixels of {pixel:.2g} m"
    if inputs.on_surface or share > ENOUGH:
        log.info("%s", density)
        return
    log.warning(
        "%s: a point falls into %.0f %% of the pixels, and the others get no label. "
        "project.recipe: surface labels pixels between points, too",
        density,
        share,
    )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Makes the blocks (rows, cols) of a view's grid; plain values, for other processes.

    First what the LiDAR decides of a block, which is kept in a file in ``folder`` (recipe surface);
    then the layers, by that of the block and of those around it, which go to ``out``. ``content``:
    digest of all that labels follow from but points and their surface. ``rows``: those of the grid
    that this job makes layers of; of blocks beside these it needs little.
    """

    scene: SceneInputs
    out: BlockStore
    content: str
    folder: Path
    rows: slice

    def around(self, block: Block) -> list[Block]:
        """The blocks whose labels have a say in a block, with itself."""
        side, shape = self.out.shard, self.scene.pair.model.shape
        reach = -(-self.scene.image_margin // side)
        starts = (
            range(max(edge.start - reach * side, 0), min(edge.start + reach * side + 1, size), side)
            for edge, size in zip(block, shape)
        )
        return [
            tuple(slice(first, min(first + side, size)) for first, size in zip(corner, shape))
            for corner in product(*starts)
        ]

    def parts_around(self, block: Block) -> dict[str, Block]:
        """The same by name, as far as the rows of this job need them."""
        margin = self.scene.image_margin
        low, high = self.rows.start - margin, self.rows.stop + margin
        parts = {}
        for rows, cols in self.around(block):
            kept = slice(max(rows.start, low), min(rows.stop, high))
            if kept.start < kept.stop:
                parts["-".join(str(e.start // self.out.shard) for e in (kept, cols))] = kept, cols
        return parts

    def key(self, block: Block, margin: int = 0) -> str:
        """Digest of all that the LiDAR decides of a block and ``margin`` px around it by:
        ``content``, points and surface."""
        block = block[0], self.scene.pair.cols(block[1])
        window = tuple(slice(edge.start - margin, edge.stop + margin) for edge in block)
        points = sorted(_identity(store.attrs) for store in self.scene.windows.touched(*window))
        surface = [part.checksum for part in self.scene.surface_blocks(*window)]
        return digest({"content": self.content, "points": points, "surface": surface})

    def make_lidar(self, name: str, block: Block) -> None:
        """Keep what the LiDAR decides of a block and the numbers of its points, if it is not there.

        No file, if the block has no points.
        """
        ledger, file, key = Ledger(self.folder), self._file(name), self.key(block)
        if ledger.find(name, key, {"labels": file}) is not None:
            return
        by_lidar = lidar_labels(self.scene, block[0], self.scene.pair.cols(block[1]))
        counts = [0, 0]
        if by_lidar is not None:
            by_lidar[0].write(file)
            counts = by_lidar[1].tolist()
        refuse_replaced(self.out.inputs)
        ledger.put(name, key, {"labels": file}, counts)

    def make(self, key: str, block: Block, _after: Sequence[None] = ()) -> None:
        """Label one block and write it, with its pixels by status and what is COUNTED.

        Nothing, if it is there: a Dask worker that is lost takes with it that it had written it.
        """
        if self.out.has(block, key):
            return
        rows, here = block[0], self.scene.pair.cols(block[1])
        made = (
            self._layers(block) if self.scene.on_surface else label_window(self.scene, rows, here)
        )
        arrays, counts = made or ({}, np.zeros(0, np.int64))
        image = self.scene.pair.images[0]
        if made is None and isinstance(image, MaskedImage):
            masked = image.mask[rows, here] != 0
            arrays = {"status": masked * np.uint8(Status.MASKED)} if masked.any() else {}
        arrays = self.scene.pair.arrays(arrays)
        shape = rows.stop - rows.start, here.stop - here.start
        status = arrays.get("status", np.zeros(shape, np.uint8))
        pixels = np.bincount(status.reshape(-1), minlength=len(Status))
        counted = np.zeros(len(COUNTED), np.int64)
        counted[: counts.size] = counts
        self.out.write(block, key, arrays, [*pixels.tolist(), *counted.tolist()])

    def _layers(self, block: Block) -> tuple[Mapping[str, NDArray], NDArray[np.int64]] | None:
        """Of a block, and what is COUNTED there; None without points."""
        parts, cols_of = self.parts_around(block), self.scene.pair.cols
        own = next(name for name, part in parts.items() if part == block)
        if not self._file(own).exists():
            return None
        files = [(self._file(name), (part[0], cols_of(part[1]))) for name, part in parts.items()]
        margin, (rows, here) = self.scene.image_margin, (block[0], cols_of(block[1]))
        window = (slice(edge.start - margin, edge.stop + margin) for edge in (rows, here))
        layers, counts = image_layers(self.scene, rows, here, LidarLabels.read(files, *window))
        return layers, np.concatenate([Ledger(self.folder).get(own).result, counts])

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}.labels"

    def forget(self, name: str, _after: Sequence[None]) -> None:
        """Remove what is kept of a block, once all that it has a say in are made."""
        self._file(name).unlink(missing_ok=True)

    def tasks(self, missing: Sequence[tuple[str, Block]]) -> list[Any]:
        """That make the ``missing`` blocks, each with its key."""

        def delayed(call: Callable, kind: str, block: Block, *arguments: object) -> Any:
            name = f"{kind}-{block[0].start:07d}-{block[1].start:07d}"
            return dask.delayed(call, pure=False)(*arguments, dask_key_name=name)

        lidar: dict[str, Any] = {}
        tasks = []
        readers: dict[str, list[Any]] = {}
        for key, block in missing:
            parts = self.parts_around(block) if self.scene.on_surface else {}
            for name, part in parts.items():
                if name not in lidar:
                    lidar[name] = delayed(self.make_lidar, "lidar", part, name, part)
            after = [lidar[name] for name in parts]
            tasks.append(delayed(self.make, MAKES_LAYERS, block, key, block, after))
            for name in parts:
                readers.setdefault(name, []).append(tasks[-1])
        for number, (name, after) in enumerate(readers.items()):
            forget = dask.delayed(self.forget, pure=False)
            tasks.append(forget(name, after, dask_key_name=f"forget-{number:07d}"))
        return tasks


def _identity(attrs: Mapping[str, Any]) -> str:
    """What stands for the values of a store; something new each time if it has no record.

    Of points, what was read of their file belongs to it.
    """
    made_of = attrs.get("provenance") or {"unknown": os.urandom(8).hex()}
    return attrs.get("content") or digest({**made_of, "points": attrs.get("cells_crc32")})


@dataclass(frozen=True, eq=False)
class _Extent:
    """Where a scene's points and images are: boxes (west, south, east, north, degrees), ``heights``
    (lowest, highest, m) of the points, folder of these."""

    points: tuple[float, ...]
    images: tuple[float, ...]
    heights: tuple[float, float]
    folder: Path

    @classmethod
    def of(cls, inputs: SceneInputs) -> _Extent:
        """Raises InputError where the images reach no ground."""
        (rows, cols), stores = inputs.pair.model.shape, inputs.stores
        corners = np.array([store.bounds for store in stores])
        points = *corners[:, :2].min(0).tolist(), *corners[:, 2:4].max(0).tolist()
        heights = float(corners[:, 4].min()), float(corners[:, 5].max())
        images = inputs.windows.ground_box(slice(0, rows), slice(0, cols), *heights)
        if images is None:
            raise InputError(
                "the epipolar model reaches no ground",
                file=inputs.left_store,
                remedy="run rectify again",
            )
        return cls(points, images, heights, stores[0].path.parent)

    def refuse(self) -> NoReturn:
        """InputError: the points lie elsewhere."""
        refuse_apart(self.points, self.images, self.heights, self.folder)


def _attributes(inputs: SceneInputs, extent: _Extent, scene: str, code: str) -> dict[str, Any]:
    """Attributes of a scene's grid, but for the summary."""
    stores = {"left": require_complete(inputs.left_store).attrs}
    stores["right"] = require_complete(inputs.right_store).attrs
    epipolar = dict(stores["left"]["epipolar"])
    stores |= {f"points/{store.path.name}": store.attrs for store in inputs.stores}
    if inputs.on_surface:
        stores["surface"] = inputs.ground.attrs
    made_of = {name: digest(dict(attrs.get("provenance", {}))) for name, attrs in stores.items()}
    if inputs.alignment is not None:
        made_of |= checksums([inputs.alignment])
    parameters, model = _parameters(inputs), EpipolarModel.from_dict(epipolar)
    return {
        "kind": "disparity",
        "scene": scene,
        "view": inputs.view,
        "epipolar": epipolar,
        **coarse_place(model, inputs.view),
        "points_bounds": [*extent.points, *extent.heights],
        "alignment_sigma_px": inputs.pair.uncertainty.sigma,
        "points_per_m2": round(inputs.points_per_m2, 4),
        "points_per_px": round(inputs.points_per_m2 * inputs.rays.pixel_m**2, 4),
        "points_bounds_order": "lon_min, lat_min, lon_max, lat_max (degrees), "
        "height_min, height_max (m, ellipsoidal)",
        "lidar": lidar_read(inputs, model),
        "settings": parameters,
        "light": None if inputs.light is None else asdict(inputs.light),
        "provenance": describe(made_of, parameters, code),
    }


def _parameters(inputs: SceneInputs) -> dict[str, Any]:
    """Of a scene's labels: its view and the settings."""
    return {"view": inputs.view} | inputs.settings.model_dump()


def _content(inputs: SceneInputs, code: str) -> str:
    """Digest of all that the labels follow from but the points."""
    left, right = (require_complete(p).attrs for p in (inputs.left_store, inputs.right_store))
    parameters = _parameters(inputs)
    if inputs.on_surface:
        parameters["scale"] = asdict(inputs.scale)
    return digest(
        {
            "images": [_identity(left), _identity(right)],
            "epipolar": left["epipolar"],
            "uncertainty": inputs.pair.uncertainty.content,
            "edge_margin_px": inputs.edge_margin_px,
            "parameters": parameters,
            "code": code,
        }
    )


def project_scene(
    inputs: SceneInputs,
    out: str | Path,
    *,
    code: str,
    scene: str = "",
    workers: int = 1,
    scheduler: Any = dask.threaded.get,
    strip: Strip | None = None,
) -> dict[str, Any] | None:
    """Project the points of a scene and write its disparity grid; returns the summary.

    ``inputs``: see :meth:`.scene_inputs.SceneInputs.of`. ``code``: digest of the source, for the
    provenance. ``scheduler`` is what Dask's compute takes; ``workers`` the number of its threads.

    Blocks that an earlier call has left, made of the same, are taken over (see
    :mod:`stereotruth.core.products.resumable_grids`). ``strip``: make its blocks only, for a later
    call without it, and return None.

    The store [y, x] on the epipolar grid of the view: see :func:`.layers.layers`; attributes
    ``epipolar`` (the model), ``view``, ``summary``, ``points_bounds``, ``alignment_sigma_px``
    (standard uncertainty of a ground point's disparity, x and y: medians), ``provenance``. Summary:
    ``pixels`` by status, ``points`` (in the grid, in both frames, used), ``labelled_share`` of the
    pixels that have points. Of the recipe surface also how many pixels were ``asked`` whether they
    have changed, and the share of these that lies ``beyond_learned``, by each figure of
    :class:`.change_evidence.Evidence`.

    Raises InputError if no point falls into both images.
    """
    out = Path(out).absolute()
    if not inputs.point_stores:
        raise InputError("no point store", file=out, remedy="give the scene's LiDAR files")
    extent = _Extent.of(inputs)
    if apart(extent.points, extent.images) or not any(store.count for store in inputs.stores):
        extent.refuse()
    attrs = _attributes(inputs, extent, scene, code)
    _log_density(inputs)
    content = _content(inputs, code)
    shape = inputs.pair.model.shape
    grid = resumable_grid(
        out,
        shape,
        layers(inputs.settings, inputs.view, inputs.has_masks),
        chunk=CHUNK,
        shard=SHARD,
        shared=strip is not None,
    )
    with grid as unfinished:
        every = blocks(shape, SHARD)
        part = every if strip is None else strip.of(every)
        rows = slice(part[0][0].start, part[-1][0].stop) if part else slice(0, 0)
        folder = unfinished.folder / "lidar" / str(strip or "all")
        job = _Blocks(inputs, unfinished, content, folder, rows)
        margin = inputs.image_margin if inputs.on_surface else 0
        keys = [job.key(block, margin) for block in part]
        missing = [(keys[k], part[k]) for k in unfinished.missing(part, keys, workers)]
        tasks = job.tasks(missing)
        if tasks and inputs.on_surface:
            _ = inputs.noise  # once, and not by each of the threads
        with block_progress(len(missing), "disparity", MAKES_LAYERS):
            dask.compute(*tasks, scheduler=scheduler, num_workers=workers)
        if strip is not None:
            return None
        summary = _summary(inputs, np.sum(unfinished.results(every), axis=0).tolist())
        if summary["points"]["in_frame"] == 0:
            extent.refuse()
        unfinished.write_atomically(out, every, attrs | {"summary": summary})
        shutil.rmtree(unfinished.folder / "lidar", ignore_errors=True)
    _log_summary(inputs.settings.recipe, summary)
    return summary


def _summary(inputs: SceneInputs, counts: list[int]) -> dict[str, Any]:
    """Of pixels by status and what is counted (see :meth:`_Blocks.make`)."""
    pixels = {status.label: counts[status] for status in inputs.statuses}
    counted = dict(zip(COUNTED, counts[len(Status) :]))
    beyond = "no_points", "out_of_frame", "masked"
    reached = sum(n for name, n in pixels.items() if name not in beyond)
    labelled = sum(counts[status] for status in inputs.statuses if is_labelled(status))
    out = {
        "pixels": pixels,
        "points": {name: counted[name] for name in COUNTED[:3]},
        "labelled_share": round(labelled / max(reached, 1), 6),
    }
    if inputs.on_surface:
        asked = max(counted["asked"], 1)
        out["asked"] = counted["asked"]
        out["beyond_learned"] = {n: round(counted[n] / asked, 4) for n in Evidence._fields}
    return out


def _log_summary(recipe: str, summary: Mapping[str, Any]) -> None:
    """Log how many pixels have labels, and warn if these are few."""
    pixels, share = summary["pixels"], summary["labelled_share"]
    log.info(
        "%s: %d pixels labelled, %.1f %% of those with points in both images (%s)",
        recipe,
        sum(n for name, n in pixels.items() if carries_label(name)),
        100.0 * share,
        ", ".join(f"{name} {n}" for name, n in pixels.items() if n and name != "labelled"),
    )
    if share < LEAST_LABELLED:
        log.warning(
            "only %.0f %% of the pixels with points are seen alike in both images: check the "
            "vertical datum of the LiDAR (geoid in scenes.tsv), its CRS and the GCP residuals",
            100.0 * share,
        )
    beyond = {n: v for n, v in summary.get("beyond_learned", {}).items() if v > FAR_BEYOND}
    if beyond:
        log.warning(
            "what the images show differs from what changes were learned from: %s of the %d pixels "
            "that do not agree closely. Look at what is `changed`, and at what is not",
            ", ".join(f"{name} at {100.0 * share:.0f} %" for name, share in beyond.items()),
            summary["asked"],
        )
