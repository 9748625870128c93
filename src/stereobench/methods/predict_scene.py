"""A stereo method over the rectified images of a whole scene, in tiles that outlive their job.

The method makes the tiles (:mod:`.tiling`), side by side in a grid of their own, one to a file,
kept as :mod:`stereotruth.core.products.resumable_grids` keeps blocks until the scene is whole; then
the blocks of the scene are blended from the tiles that reach into them. Memory is that of the tiles
at work. A job that was killed goes on with the tiles that lack; the result has the same bytes for
any number of workers and kills, as far as the method itself gives the same for the same tile (SGM
does; PyTorch does on one machine).
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import dask.array as da
import dask.threaded
import numpy as np
import zarr
from numpy.typing import NDArray

from stereotruth.core.config.methods import CHUNK, SceneMatching
from stereotruth.core.errors import InputError
from stereotruth.core.job import block_progress
from stereotruth.core.products.grids import Layer, require_complete
from stereotruth.core.products.provenance import describe, digest, file_sha256
from stereotruth.core.products.resumable_grids import BlockStore, resumable_grid
from stereotruth.epipolar.intersection import PLACE

from .kinds import kind_of, names_of
from .matcher import Matcher
from .methods import make_method
from .tiling import Offsets, Tiling, blend, find_offsets, predict_tile

log = logging.getLogger("stereotruth")
DisparityRange = tuple[int, int]
Place = tuple[int, int]
Window = tuple[slice, slice]


LAYERS = {
    "disparity": Layer(
        "float32",
        float("nan"),
        {
            "units": "px",
            "long_name": "disparity x_left - x_right by a stereo method",
            "nodata": "NaN",
        },
    )
}


@dataclass(frozen=True, eq=False)
class _ImagePair:
    """What every tile needs: plain values, so that it can go to another process."""

    left_store: Path
    right_store: Path
    method: str
    entry: Mapping[str, Any]
    threads: int  # of the method
    disparity_range: DisparityRange
    tiling: Tiling
    margin: int | None
    scaling: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    @cached_property
    def images(self) -> tuple[zarr.Array, zarr.Array]:
        stores = (self.left_store, self.right_store)
        left, right = (require_complete(path)["image"] for path in stores)
        if left.shape != right.shape:
            raise InputError(
                f"left image of {left.shape} px, right image of {right.shape}",
                file=self.right_store,
                remedy="run rectify again",
            )
        return left, right

    @cached_property
    def matcher(self) -> Matcher:
        return make_method(self.method, self.entry, self.threads)

    def tile(self, out: BlockStore, key: str, place: Place, offset: int) -> None:
        """Predict one tile and write it to its place in the grid of tiles."""
        found = predict_tile(
            self.matcher,
            self.images,
            self.tiling,
            place,
            self.disparity_range,
            offset,
            margin_px=self.margin,
            scaling=self.scaling,
        )
        arrays = {"disparity": found} if np.isfinite(found).any() else {}
        out.write(self._stored(place), key, arrays, None)

    def block(self, tiles: BlockStore, out: BlockStore, key: str, place: Place) -> None:
        """Blend one block; its result: count of valid pixels, least and greatest disparity."""
        stored = zarr.open_group(tiles.store, mode="r")["disparity"]
        around = {other: stored[self._stored(other)] for other in self.tiling.around(place)}
        found = blend(self.tiling, place, around)
        valid = np.isfinite(found)
        arrays, result = {}, [0, None, None]
        if valid.any():
            arrays = {"disparity": found}
            result = [int(valid.sum()), *(float(f(found[valid])) for f in (np.min, np.max))]
        out.write(self.tiling.block_window(place), key, arrays, result)

    def _stored(self, place: Place) -> Window:
        side = self.tiling.side
        return tuple(slice(k * side, (k + 1) * side) for k in place)


def _search(attrs: Mapping[str, Any]) -> DisparityRange | None:
    """The disparities of the heights that the epipolar model is made for, with some reserve."""
    try:
        low, high = attrs["epipolar"]["report"]["disparity_range_px"]
    except (KeyError, TypeError):
        return None
    reserve = 0.1 * (high - low) + 64.0
    return int(np.floor(low - reserve)), int(np.ceil(high + reserve))


def _run(
    work: Callable[..., None],
    arguments: Sequence[tuple[Any, ...]],
    what: str,
    scheduler: Any,
    workers: int,
) -> None:
    """Do the work with each of the arguments, by Dask; ``what`` names it in the log."""
    tasks = [
        dask.delayed(work, pure=False)(*given, dask_key_name=f"{what}-{number:07d}")
        for number, given in enumerate(arguments)
    ]
    with block_progress(len(tasks), what):
        dask.compute(*tasks, scheduler=scheduler, num_workers=workers)


def predict_scene(
    left_store: str | Path,
    right_store: str | Path,
    out: str | Path,
    *,
    method: str,
    entry: Mapping[str, Any],
    settings: SceneMatching,
    workers: int = 1,
    scheduler: Any = dask.threaded.get,
    code: str = "",
    scene: str = "",
) -> dict[str, Any]:
    """Write the disparity of a scene by a method as a Zarr grid; returns its summary.

    ``left_store``, ``right_store``: rectified images as `rectify` makes them. ``method``: a name
    for messages; ``entry``: its configuration entry (:func:`..methods.make_method`).
    ``settings``: how the method goes over the scene, with a disparity range.
    ``workers`` tiles are worked on at once by SGM, while networks and functions get that many
    threads. ``scheduler`` is what Dask's compute takes. ``code``: digest of the source, for the
    provenance.

    The store [y, x] on the left epipolar grid: ``disparity`` (:data:`LAYERS`); attributes
    ``epipolar`` (the model), ``block_offsets_px`` [n][m], ``summary`` (valid share, least and
    greatest disparity, px), ``settings``, ``provenance``.

    Raises InputError for images that nowhere match, and settings that the method does not take.
    """
    left_store, right_store, out = (Path(p).absolute() for p in (left_store, right_store, out))
    kind = kind_of(method, entry)
    left_attrs, right_attrs = (
        dict(require_complete(path).attrs) for path in (left_store, right_store)
    )
    shape = require_complete(left_store)["image"].shape
    start = _ImagePair(
        left_store,
        right_store,
        method,
        dict(entry),
        threads=1 if kind.tiles_at_once else workers,
        disparity_range=tuple(settings.disparity_range),
        tiling=Tiling(shape, settings.block_px, settings.overlap_px),
        margin=settings.margin_px,
    )
    moved = _offsets(start, settings, left_attrs)
    scaling = start.matcher.scaling(*map(da.from_zarr, start.images))
    job = replace(start, scaling=scaling)
    parameters = _parameters(job, settings)
    files = [file for file in kind.files(entry) if file.is_file()]
    made_of = {
        name: digest(dict(attrs.get("provenance", {})))
        for name, attrs in (("left", left_attrs), ("right", right_attrs))
    }
    content = digest(
        {
            "images": [
                attrs.get("content") or made_of[name]
                for name, attrs in (("left", left_attrs), ("right", right_attrs))
            ],
            "method": digest(
                {"settings": dict(entry), "files": [file_sha256(path) for path in files]}
            ),
            "range": parameters["disparity_range"],
            "margin": parameters["margin_px"],
            "tiling": [settings.block_px, settings.overlap_px],
            "code": code,
        }
    )
    windows = [job.tiling.block_window(place) for place in job.tiling.places()]
    with resumable_grid(out, shape, LAYERS, chunk=CHUNK, shard=settings.block_px) as unfinished:
        tiles = out.with_name(f"{out.name}.tiles")
        folder = _make_blocks(
            job, content, moved.offsets, (unfinished, tiles), (scheduler, workers)
        )
        summary = _summary(unfinished.results(windows), shape, moved)
        inputs = made_of | {name: file_sha256(path) for name, path in names_of(files).items()}
        attrs = {
            "kind": "prediction",
            "scene": scene,
            "view": "left",
            "epipolar": left_attrs.get("epipolar"),
            **{name: left_attrs[name] for name in PLACE if name in left_attrs},
            "settings": parameters,
            "block_offsets_px": moved.offsets.tolist(),
            "summary": summary,
            "provenance": describe(inputs, parameters, code),
        }
        unfinished.write_atomically(out, windows, attrs)
        shutil.rmtree(folder, ignore_errors=True)
    log.info(
        "%s: %.1f %% of the grid has a disparity, %.0f to %.0f px",
        method,
        100.0 * summary["valid_share"],
        summary["disparity_min_px"],
        summary["disparity_max_px"],
    )
    return summary


def _offsets(pair: _ImagePair, settings: SceneMatching, attrs: Mapping[str, Any]) -> Offsets:
    """By how much the right image is moved for each block."""
    if settings.offset != "auto":
        count = pair.tiling.count
        return Offsets(np.full(count, settings.offset, np.int64), np.ones(count, np.bool_), 1.0)
    return find_offsets(*pair.images, pair.tiling, pair.disparity_range, _search(attrs))


def _parameters(job: _ImagePair, settings: SceneMatching) -> dict[str, Any]:
    """What a prediction follows from besides its files, for its record."""
    return {
        "method": job.method,
        "method_settings": dict(job.entry),
        "disparity_range": list(job.disparity_range),
        "block_px": settings.block_px,
        "overlap_px": settings.overlap_px,
        "offset": settings.offset,
        "margin_px": job.matcher.margin_px if job.margin is None else job.margin,
    }


def _make_blocks(
    job: _ImagePair,
    content: str,
    offsets: NDArray[np.int64],
    to: tuple[BlockStore, Path],
    by: tuple[Any, int],
) -> Path:
    """Make the tiles that are missing, and all blocks from them; the folder of the tiles.

    ``content``: digest of all that the disparities follow from but the ``offsets`` [n, m], px.
    ``to``: the store of the blocks, and the path of that of the tiles. ``by``: Dask's scheduler and
    its workers, which make one tile at a time if the method itself has several threads.
    """
    (blocks, out), (scheduler, workers) = to, by
    places = list(job.tiling.places())
    keys = [digest({"content": content, "offset": int(offsets[place])}) for place in places]
    side = job.tiling.side
    shape = tuple(n * side for n in job.tiling.count)
    with resumable_grid(out, shape, LAYERS, chunk=side, shard=side) as tiles:
        missing = tiles.missing([job._stored(place) for place in places], keys, workers)
        _run(
            job.tile,
            [(tiles, keys[k], places[k], int(offsets[places[k]])) for k in missing],
            f"tiles by {job.method}",
            scheduler,
            workers if job.threads == 1 else 1,
        )
        made = [(tiles, blocks, content, place) for place in places]
        _run(job.block, made, "blending", scheduler, workers)
    return tiles.folder


def _summary(results: Sequence[Sequence[Any]], shape: tuple[int, int], moved: Offsets) -> dict:
    count = sum(result[0] for result in results)
    if not count:
        raise InputError(
            "the method gave no disparity at all", remedy="check its disparity range and offset"
        )
    return {
        "valid_share": round(count / (shape[0] * shape[1]), 6),
        "disparity_min_px": min(result[1] for result in results if result[0]),
        "disparity_max_px": max(result[2] for result in results if result[0]),
        "offset_min_px": int(moved.offsets.min()),
        "offset_max_px": int(moved.offsets.max()),
        "blocks_without_offset_of_their_own": int((~moved.known).sum()),
        "coarse_disparities_in_range": round(moved.in_range, 6),
    }
