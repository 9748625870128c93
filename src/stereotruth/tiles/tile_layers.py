"""The values of the layers of :mod:`.layer_kinds` in a tile, and their files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.products.rasters import write_tiff
from ..epipolar.intersection import intersect
from .ground_heights import heights_above_ground
from .layer_kinds import KINDS
from .scene_stores import SceneStores

MARGIN_PX = 128  # around a tile, from which the ground below its roofs is known


def tile_layers(
    source: SceneStores, here: tuple[slice, slice], names: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """The layers of a tile at those rows and columns, as their files have them [h, w]."""
    if not names:
        return {}
    known = np.isfinite(np.asarray(source.disparity[here]))
    values: dict[str, NDArray[Any]] = {}
    if "class" in names:
        values["class"] = _classes(source, here)
    if "lidar_date" in names:
        dates = source.lidar_date
        values["lidar_date"] = np.zeros(known.shape) if dates is None else dates[here]
    if "uncertainty" in names:
        sigma = source.uncertainty
        values["uncertainty"] = np.full(known.shape, np.nan) if sigma is None else sigma[here]
    if "height" in names or "agl" in names:
        rows, cols = source.left.shape
        wide = tuple(
            slice(max(s.start - MARGIN_PX, 0), min(s.stop + MARGIN_PX, n))
            for s, n in zip(here, (rows, cols))
        )
        inner = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(here, wide))
        read = wide if "agl" in names else here
        disparity = np.asarray(source.disparity[read], np.float32)
        ground = intersect(source.model, disparity, read[0].start, read[1].start)
        part = inner if "agl" in names else np.s_[:, :]
        values["height"] = ground[2][part]
        if "agl" in names:
            values["agl"] = heights_above_ground(ground, _classes(source, wide))[part]
    return {name: _stored(name, values[name], known) for name in names}


def _classes(source: SceneStores, window: tuple[slice, slice]) -> NDArray[np.uint8]:
    if source.surface_class is None:
        return np.zeros(source.left[window].shape, np.uint8)
    return np.asarray(source.surface_class[window])


def _stored(name: str, values: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[Any]:
    """Values as the file has them: nodata where the pixel has no label."""
    kind = KINDS[name]
    dtype = np.dtype(kind.dtype)
    with np.errstate(invalid="ignore"):
        good = known & np.isfinite(values.astype(np.float64))
    return np.where(good, values, kind.nodata).astype(dtype)


def write_layer(path: Path, name: str, values: NDArray[Any]) -> None:
    """Write a layer's TIFF."""
    kind = KINDS[name]
    write_tiff(path, values, nodata=kind.nodata, description=kind.description)
