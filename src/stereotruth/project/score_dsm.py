"""A surface model of any origin against LiDAR files or a reference raster, without a project."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.sheets import lidar_files, store_names
from ..core.tables import epoch_year
from ..evaluate.surface_models.reference import LidarReference, RasterReference
from ..evaluate.surface_models.score import describe, score_surface_model, write_verdict
from ..lidar.frames import DEFAULT_EPOCH, Epoch, Epochs
from ..lidar.ingest import ingest


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
    epoch: str = "",
) -> str:
    """Write the verdict to the folder ``to``; what to say of it.

    ``lidar``: a folder or glob of LAS, LAZ, COPC; or else ``reference``, a raster of heights.
    ``geoid``, ``reference_geoid``: grids from which the heights of either count, instead of from
    the ellipsoid. ``epoch``: of the images that the model was made from, decimal year or date;
    national frames are brought to ITRF2020 at it. Raises InputError, also if none or both of the
    references are given.
    """
    if bool(lidar) == (reference is not None):
        raise InputError(
            "a surface model needs one reference", file=model, remedy="give --lidar or --reference"
        )
    try:
        year = epoch_year(epoch)
    except ValueError as error:
        raise InputError(f"--epoch {epoch!r} {error}", file=model, remedy="as 2016.4") from None
    epochs = Epochs(DEFAULT_EPOCH if year is None else Epoch(year, "--epoch"))
    with tempfile.TemporaryDirectory(prefix="stereotruth-") as scratch:
        against: LidarReference | RasterReference
        if reference is not None:
            against = RasterReference(reference, reference_geoid, reference_classes, epochs=epochs)
        else:
            stores = []
            for name, file in store_names(lidar_files(lidar)).items():
                stores.append(Path(scratch) / f"{name}.points")
                how = {"lidar_crs": lidar_crs, "geoid": reference_geoid, "epochs": epochs}
                ingest(file, stores[-1], **how)
            against = LidarReference(stores)
        verdict = score_surface_model(model, against, geoid=geoid, epochs=epochs)
        figures: dict[str, Any] = write_verdict(verdict, to, model.name)
    return f"{model.name}: {describe(figures)}; look at {to / 'index.html'}"
