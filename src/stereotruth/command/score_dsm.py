"""A surface model of any origin against LiDAR files or a reference raster, without a project."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..evaluation.surface_models.page import describe, write_verdict
from ..evaluation.surface_models.reference import LidarReference, RasterReference
from ..evaluation.surface_models.score import score_surface_model
from ..lidar.ingest import ingest
from ..sheets import lidar_files, store_names


def score_dsm(
    model: Path,
    to: Path,
    *,
    lidar: str = "",
    reference: Path | None = None,
    geoid: Path | None = None,
    lidar_crs: str = "",
    reference_geoid: Path | None = None,
    reference_classes: Path | None = None,
) -> str:
    """Write the verdict to the folder ``to``; what to say of it.

    ``lidar``: a folder or glob of LAS, LAZ, COPC; or else ``reference``, a raster of heights.
    ``geoid``, ``reference_geoid``: grids from which the heights of either count, instead of from
    the ellipsoid. Raises InputError, also if none or both of the references are given.
    """
    if bool(lidar) == (reference is not None):
        raise InputError(
            "a surface model needs one reference", file=model, remedy="give --lidar or --reference"
        )
    with tempfile.TemporaryDirectory(prefix="stereotruth-") as scratch:
        against: LidarReference | RasterReference
        if reference is not None:
            against = RasterReference(reference, reference_geoid, reference_classes)
        else:
            files = store_names(lidar_files(lidar))
            against = LidarReference(
                _ingested(files, Path(scratch), lidar_crs or None, reference_geoid)
            )
        verdict = score_surface_model(model, against, geoid=geoid)
        figures: dict[str, Any] = write_verdict(verdict, to, model.name)
    return f"{model.name}: {describe(figures)}; look at {to / 'index.html'}"


def _ingested(
    files: dict[str, Path], folder: Path, lidar_crs: str | None, geoid: Path | None
) -> Sequence[Path]:
    stores = []
    for name, file in files.items():
        stores.append(folder / f"{name}.points")
        ingest(file, stores[-1], lidar_crs=lidar_crs, geoid=geoid)
    return stores
