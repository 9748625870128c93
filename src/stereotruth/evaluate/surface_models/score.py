"""A surface model held against LiDAR or a reference raster.

    from stereotruth.evaluate.surface_models.reference import RasterReference
    from stereotruth.evaluate.surface_models.score import score_surface_model

    verdict = score_surface_model("dsm.tif", RasterReference("truth.tif"))
    verdict.figures()["edges"]["position_error_m"]

The model is registered first (:mod:`.registration`); all else is said of it where it then lies.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.job import progress
from ...lidar.frames import DEFAULT_EPOCHS, Epochs
from ...lidar.height_raster import Floats, HeightRaster, Window
from .edges import REACH_M, EdgeErrors, find_edges, measure
from .height_errors import SOLID, HeightErrors, strata
from .reference import TREE, WATER, Reference, lattice_of, lattice_step
from .registration import GROUPS, SEARCH_M, Part, Registration, register

log = logging.getLogger("stereotruth")

BLOCK = 512  # cells of a window
PARTS = 48  # windows that the registration sees, about
AROUND_M = REACH_M + 2.0  # of a window, for what is said of its points
MAP_SIDE = 700  # squares of the map of differences at most


@dataclass(frozen=True)
class Verdict:
    """What was found of a surface model.

    ``delivered``: errors as the model comes, by stratum; ``registered``: after the shift is taken
    out. ``differences`` float32[h, w]: mean of model less reference (m), registered, for the map.
    """

    model: HeightRaster
    reference: Reference
    registration: Registration
    delivered: HeightErrors
    registered: dict[str, HeightErrors]
    edges: EdgeErrors
    differences: Floats

    def figures(self) -> dict[str, Any]:
        """JSON-ready; m."""
        return {
            "model": self.model.path.name,
            "reference": self.reference.name,
            "cell_m": [round(v, 4) for v in self.model.cell_m],
            "registration": self.registration.figures(),
            "as_delivered": self.delivered.figures(),
            "errors": {name: of.figures() for name, of in self.registered.items()},
            "edges": self.edges.figures(),
            "edge_profile": self.edges.mean_profile(),
        }


def _windows(shape: tuple[int, int], side: int) -> list[tuple[slice, slice]]:
    return [
        (slice(r, min(r + side, shape[0])), slice(c, min(c + side, shape[1])))
        for r in range(0, shape[0], side)
        for c in range(0, shape[1], side)
    ]


def _read(model: HeightRaster, rows: slice, cols: slice, margin_m: float) -> Window:
    """The model's heights in a window and around it."""
    more = [int(np.ceil(margin_m / step)) + 2 for step in model.cell_m[::-1]]
    wide = [slice(w.start - m, w.stop + m) for w, m in zip((rows, cols), more)]
    return Window(model.window(*wide), (wide[0].start, wide[1].start), model.cell_m)


def _parts(model: HeightRaster, reference: Reference, step_m: float) -> Iterator[tuple[Part, int]]:
    """Windows of the model with the reference's solid points, spread over it, and their groups."""
    side = int(np.clip(np.sqrt(model.shape[0] * model.shape[1] / PARTS), 24, BLOCK))
    windows = _windows(model.shape, side)
    rng = np.random.default_rng(0)
    if len(windows) > 2 * PARTS:
        windows = [windows[k] for k in sorted(rng.choice(len(windows), PARTS, replace=False))]
    groups = rng.permutation(len(windows)) % GROUPS
    for window, group in zip(windows, groups):
        lattice = lattice_of(reference, model, *window, step_m, AROUND_M)
        solid = np.isfinite(lattice.z) & (lattice.kind != TREE) & (lattice.kind != WATER)
        solid &= lattice.own & lattice.even
        heights = _read(model, *window, SEARCH_M + REACH_M + 8.0)
        if solid.any() and np.isfinite(heights.heights).any():
            places = (v[solid] for v in (lattice.x, lattice.y, lattice.z))
            yield Part(heights, *places, find_edges(lattice, reference.classified)), int(group)


def score_surface_model(
    path: str | Path,
    reference: Reference,
    *,
    geoid: str | Path | None = None,
    epochs: Epochs = DEFAULT_EPOCHS,
) -> Verdict:
    """Judge a GeoTIFF of heights (m, or its system's vertical unit).

    Heights count from the WGS 84 ellipsoid, or from the geoid whose grid ``geoid`` names. A model
    of any north-up grid will do, in degrees or a projection. ``epochs``: of the images that it was
    made from, at which national frames are brought to ITRF2020 (:mod:`...lidar.frames`); those of
    the reference have to be the same. Raises InputError for a file that is no such raster, and for
    a reference that shares no ground with it.
    """
    model = HeightRaster.open(path, geoid, epochs=epochs)
    step_m = lattice_step(reference, model)
    parts = list(_parts(model, reference, step_m))
    found = None
    if parts:
        found = register(*map(list, zip(*parts)), model.to_enu)
    if found is None:
        raise InputError(
            f"no place has both a height and a reference ({reference.name})",
            file=path,
            remedy="give a reference of the model's area, and the right coordinate system for both",
        )
    log.info(
        "%s: %.2f m east, %.2f m north, %.2f m up of its reference",
        model.path.name, found.east_m, found.north_m, found.up_m,
    )  # fmt: skip
    delivered, edges = HeightErrors(), EdgeErrors()
    registered: dict[str, HeightErrors] = {}
    coarse = max(1, -(-max(model.shape) // MAP_SIDE))
    sums = np.zeros((2, -(-model.shape[0] // coarse), -(-model.shape[1] // coarse)))
    margin = REACH_M + abs(found.east_m) + abs(found.north_m)
    along, across = np.linalg.solve(model.to_enu, [found.east_m, found.north_m])

    windows = _windows(model.shape, BLOCK)
    for window in progress(windows, len(windows), "surface model judged"):
        lattice = lattice_of(reference, model, *window, step_m, AROUND_M)
        heights = _read(model, *window, margin + 4.0)

        def height_at(x: Floats, y: Floats, heights: Window = heights) -> Floats:
            return heights.at(x + along, y + across) - found.up_m

        error = height_at(lattice.x, lattice.y) - lattice.z
        chosen = strata(lattice, reference.classified)
        for name, squares in chosen.items():
            registered.setdefault(name, HeightErrors()).add(error[squares])
        solid = chosen[SOLID]
        delivered.add(heights.at(lattice.x[solid], lattice.y[solid]) - lattice.z[solid])
        edges.add(measure(find_edges(lattice, reference.classified), height_at))
        known = lattice.own & np.isfinite(error)
        dx, dy = model.cell_m
        at = tuple(
            np.clip(np.rint(v[known] / step / coarse), 0, n - 1).astype(np.int64)
            for v, step, n in zip((-lattice.y, lattice.x), (dy, dx), sums.shape[1:])
        )
        np.add.at(sums[0], at, error[known])
        np.add.at(sums[1], at, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        differences = (sums[0] / sums[1]).astype(np.float32)
    return Verdict(model, reference, found, delivered, registered, edges, differences)
