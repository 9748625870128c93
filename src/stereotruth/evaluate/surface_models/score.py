"""A surface model held against LiDAR or a reference raster.

    from stereotruth.evaluate.surface_models.reference import RasterReference
    from stereotruth.evaluate.surface_models.score import score_surface_model

    verdict = score_surface_model("dsm.tif", RasterReference("truth.tif"))
    verdict.figures()["edges"]["position_error_m"]

The model is registered first (:mod:`.registration`); all else is said of it where it then lies.
:func:`write_verdict` leaves ``scores.json``, ``errors.csv`` and ``index.html`` in a folder.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from ...core.errors import InputError
from ...core.job import progress
from ...core.numerics import statistics
from ...core.numerics.statistics import ErrorSum
from ...core.products.files import atomic_folder, write_json, write_table
from ...core.products.grids import blocks
from ...lidar.frames import DEFAULT_EPOCHS, Epochs
from ...lidar.height_raster import Floats, HeightRaster, Window
from ...pages.figures import AXES, Chart, Plot, styled
from ...pages.page import way, write_page
from ...pages.pictures import (
    DIFFERENCES,
    SERIES,
    Picture,
    Scale,
    colours,
    encode,
    hillshade,
    shrink,
)
from ...pages.tables import Headline, minus, table, texts
from .edges import HIGH, LOW, REACH_M, SHARP, EdgeErrors, S, find_edges, measure, near_steps
from .reference import (
    BUILDING,
    GROUND,
    OTHER,
    TREE,
    WATER,
    Lattice,
    Reference,
    lattice_of,
    lattice_step,
)
from .registration import GROUPS, SEARCH_M, Part, Registration, register

log = logging.getLogger("stereotruth")

# ------------------------------------------------------ vertical errors by what the reference shows

METRES = statistics.Scale((1.0, 3.0), 0.005, 40_001)  # to ±100 m
STEP_REACH_M = 3.0  # around a step, or the shadow of one: heights there say where the edge is
CROWN_REACH_M = 1.5  # around a crown, below which slanting pulses reach the ground
SLOPES_DEG = (0.0, 5.0, 15.0, 30.0, 90.0)
SMOOTH_M = 2.0  # over which slopes are taken
SOLID = "all but trees and water"
OPEN = "off steps"  # and off crowns: the vertical error proper
STEPS = "beside steps and trees"

# The verdict.
BLOCK = 512  # cells of a window
PARTS = 48  # windows that the registration sees, about
AROUND_M = REACH_M + 2.0  # of a window, for what is said of its points
TILES_A_DEGREE = 1000  # of the table of tiles, in which models of other grids compare
MAP_SIDE = 700  # squares of the map of differences at most

# The page.
MAP_BYTES = 250_000
MAP_PX = 700
TEMPLATE = Path(__file__).with_name("page.html.jinja")


@dataclass
class HeightErrors:
    """Errors in m of a stratum: model less reference."""

    points: int = 0  # of the reference; the errors are those where the model has a height
    errors: ErrorSum = field(default_factory=lambda: ErrorSum(METRES))

    def add(self, errors: Floats) -> None:
        """Add errors [n], NaN where the model has no height."""
        self.points += errors.size
        self.errors.add(errors[np.isfinite(errors)])

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready; ``known_share``: completeness, of the reference's points."""
        e = self.errors
        shares = e.shares_beyond("m")
        if not e.count:
            lacking = ("mean_m", "mean_absolute_m", "rms_m", "median_m", "nmad_m", "le90_m")
            known = 0.0 if self.points else None
            return {"points": self.points, "known_share": known, **dict.fromkeys(lacking), **shares}
        values = {
            "known_share": e.count / self.points,
            "mean_m": e.bias,
            "mean_absolute_m": e.mean_absolute,
            "rms_m": e.rms,
            "median_m": e.median,
            "nmad_m": e.nmad,
            "le90_m": e.quantile_of_size(0.9),
            **shares,
        }
        return {"points": self.points} | {k: round(float(v), 4) for k, v in values.items()}


@dataclass
class TileSums:
    """Errors by tile of the ground, TILES_A_DEGREE: counts, sums of sizes in m."""

    sums: dict[tuple[int, int], Floats] = field(default_factory=dict)

    def add(self, model: HeightRaster, x: Floats, y: Floats, column: int, *errors: Floats) -> None:
        """Add errors [n] at places (m, of the model): count, then sums, from a column on."""
        lon, lat, _ = model.to_wgs84.exact(*model.coordinates(x, y), np.zeros(x.size))
        places = np.floor(TILES_A_DEGREE * np.stack([lat, lon])).astype(np.int64)
        names, of = np.unique(places, axis=1, return_inverse=True)
        for k, values in enumerate((np.ones(x.size), *map(np.abs, errors))):
            for name, total in zip(names.T.tolist(), np.bincount(of.ravel(), values)):
                self.sums.setdefault(tuple(name), np.zeros(5))[column + k] += total

    def rows(self) -> list[dict[str, Any]]:
        """Rows of ``tiles.csv``, from south to north; a tile is named by its south-west corner."""
        rows = []
        for south, west in sorted(self.sums):
            points, height, edges, place, width = self.sums[south, west].tolist()
            row = {"tile": f"{south / TILES_A_DEGREE:.3f} {west / TILES_A_DEGREE:.3f}"}
            row |= {"points": int(points), "mean_absolute_m": height / points if points else None}
            row |= {"edges": int(edges), "position_error_m": place / edges if edges else None}
            row |= {"resolution_m": width / edges if edges else None}
            rows.append({k: round(v, 6) if isinstance(v, float) else v for k, v in row.items()})
        return rows


def slopes(lattice: Lattice) -> Floats:
    """Slope in degrees of the ground around each square, NaN where there is none."""
    ground = (lattice.kind == GROUND) | (lattice.kind == OTHER)
    sigma = SMOOTH_M / lattice.step_m
    weight = gaussian_filter(ground.astype(np.float64), sigma)
    middle = np.nanmean(lattice.z[ground]) if ground.any() else 0.0
    z = gaussian_filter(np.where(ground, lattice.z - middle, 0.0), sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        south, east = np.gradient(z / weight, lattice.step_m)
        found = np.degrees(np.arctan(np.hypot(south, east)))
    return np.where(weight > 0.3, found, np.nan)


def strata(lattice: Lattice, classified: bool) -> dict[str, NDArray[np.bool_]]:
    """The squares of each stratum, by its name; only of the lattice's own window."""
    kind, own = lattice.kind, lattice.own & np.isfinite(lattice.z)
    solid = own & (kind != TREE) & (kind != WATER)
    reach = 2 * int(np.ceil(CROWN_REACH_M / lattice.step_m)) + 1
    crown = maximum_filter(kind == TREE, reach, mode="nearest")
    open_places = solid & ~near_steps(lattice, STEP_REACH_M) & ~crown & lattice.even
    found = {OPEN: open_places, STEPS: solid & ~open_places, SOLID: solid}
    if classified:
        found["ground, off steps"] = open_places & (kind == GROUND)
        found["buildings, off steps"] = open_places & (kind == BUILDING)
        found["other, off steps"] = open_places & (kind == OTHER)
        found["trees"] = own & (kind == TREE)
        found["water"] = own & (kind == WATER)
    slope = slopes(lattice)
    ground = open_places & (kind != BUILDING)
    for low, high in pairwise(SLOPES_DEG):
        with np.errstate(invalid="ignore"):
            chosen = ground & (slope >= low) & (slope < high)
        found[f"ground, slope {low:g}–{high:g}°"] = chosen
    return found


# -------------------------------------------------------------------------------------- the verdict


@dataclass(frozen=True)
class Verdict:
    """What was found of a surface model.

    ``delivered``: errors as the model comes, by stratum; ``registered``: after the shift is taken
    out. ``differences`` float32[h, w]: mean of model less reference (m), registered, for the map.
    ``tiles``: heights off steps and edges by tile of the ground, registered.
    """

    model: HeightRaster
    reference: Reference
    registration: Registration
    delivered: HeightErrors
    registered: dict[str, HeightErrors]
    edges: EdgeErrors
    differences: Floats
    tiles: TileSums

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


def _read(model: HeightRaster, rows: slice, cols: slice, margin_m: float) -> Window:
    """The model's heights in a window and around it."""
    more = [int(np.ceil(margin_m / step)) + 2 for step in model.cell_m[::-1]]
    wide = [slice(w.start - m, w.stop + m) for w, m in zip((rows, cols), more)]
    return Window(model.window(*wide), (wide[0].start, wide[1].start), model.cell_m)


def _parts(model: HeightRaster, reference: Reference, step_m: float) -> Iterator[tuple[Part, int]]:
    """Windows of the model with the reference's solid points, spread over it, and their groups."""
    side = int(np.clip(np.sqrt(model.shape[0] * model.shape[1] / PARTS), 24, BLOCK))
    windows = blocks(model.shape, side)
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
    delivered, edges, tiles = HeightErrors(), EdgeErrors(), TileSums()
    registered: dict[str, HeightErrors] = {}
    coarse = max(1, -(-max(model.shape) // MAP_SIDE))
    sums = np.zeros((2, -(-model.shape[0] // coarse), -(-model.shape[1] // coarse)))
    margin = REACH_M + abs(found.east_m) + abs(found.north_m)
    along, across = np.linalg.solve(model.to_enu, [found.east_m, found.north_m])

    windows = blocks(model.shape, BLOCK)
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
        lines = find_edges(lattice, reference.classified)
        seen = measure(lines, height_at)
        edges.add(seen)
        at, known = seen.found, chosen[OPEN] & np.isfinite(error)
        tiles.add(model, lines.x[at], lines.y[at], 2, seen.error[at], seen.resolution[at])
        tiles.add(model, lattice.x[known], lattice.y[known], 0, error[known])
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
    return Verdict(model, reference, found, delivered, registered, edges, differences, tiles)


# ----------------------------------------------------------------------------------------- the page


def describe(figures: dict[str, Any]) -> str:
    """The verdict in one line."""
    moved, edges, errors = figures["registration"], figures["edges"], figures["errors"][OPEN]
    text = (
        f"{moved['east_m']:+.2f} m east, {moved['north_m']:+.2f} m north, {moved['up_m']:+.2f} m "
        f"up of its reference; then {errors['mean_absolute_m']:.2f} m mean absolute error {OPEN}, "
        f"{100 * errors['known_share']:.1f} % known"
    )
    if edges["position_error_m"] is not None:
        text += f"; edges of roofs {edges['position_error_m']:.2f} m off"
        text += f", {edges['resolution_m']:.2f} m resolved"
    return minus(text)


def write_verdict(
    verdict: Verdict, folder: str | Path, title: str, *, index: str | Path | None = None
) -> dict[str, Any]:
    """Write the folder, whole or not at all; returns what stands in ``scores.json``.

    ``index``: the page of all pages, for a link.
    """
    figures = verdict.figures()
    rows = [{"stratum": name, **of} for name, of in figures["errors"].items() if of["points"]]
    rows.append({"stratum": "as delivered, all but trees and water", **figures["as_delivered"]})
    with atomic_folder(folder) as scratch:
        write_json(scratch / "scores.json", figures)
        write_table(scratch / "errors.csv", rows)
        write_table(scratch / "tiles.csv", verdict.tiles.rows())
        values = _values(verdict, figures, rows)
        values |= {"title": title, "index": way(Path(folder) / "index.html", index)}
        write_page(scratch / "index.html", TEMPLATE, values)
    return figures


@styled
def _profile(profile: list[float | None]) -> Chart:
    """The mean profile of the roofs' edges beside a sharp one."""
    plot = Plot.of("mean profile of the edges", "Beside a sharp edge (grey).", (5.6, 3.2))
    plot.axis.step(S, SHARP, where="mid", color=AXES)
    values = [np.nan if v is None else v for v in profile]
    (line,) = plot.axis.plot(S, values, marker=".", color=SERIES[0])
    known = [(s, v) for s, v in zip(S, values) if np.isfinite(v)]
    plot.hover(line, ["surface model"])
    plot.axis.set_xlabel("outward of the edge, m")
    plot.axis.set_ylabel(f"share of the step, {LOW:.0%} to {HIGH:.0%}")
    return plot.chart([{"outward_m": float(s), "share": v} for s, v in known])


def _shaded(model: HeightRaster) -> Picture:
    """Hillshade of the model, read at ``MAP_PX`` along its longer side."""
    heights, times = model.decimated(MAP_PX)
    return hillshade(heights / (times * np.mean(model.cell_m)), 1.0)


def _limit(verdict: Verdict) -> float:
    """Ends of the map's colours, m: what nine tenths of the differences keep, 0.5 at least."""
    size = np.abs(verdict.differences[np.isfinite(verdict.differences)])
    return max(float(np.ceil(20 * np.percentile(size, 90)) / 20), 0.5) if size.size else 0.5


def _values(
    verdict: Verdict, figures: dict[str, Any], rows: list[dict[str, Any]]
) -> dict[str, Any]:
    """What the page shows."""
    limit = _limit(verdict)
    picture = colours(verdict.differences, (-limit, limit), DIFFERENCES)
    return {
        "figures": figures,
        "links": [(name, name, "") for name in ("scores.json", "errors.csv", "tiles.csv")],
        "registration": _registration(figures["registration"]),
        "edges": figures["edges"],
        "table": table([texts(row) for row in rows]),
        "shaded": encode(_shaded(verdict.model), MAP_BYTES),
        "map": encode(shrink(picture, MAP_PX), MAP_BYTES),
        "profile": _profile(figures["edge_profile"]),
        "scale": Scale.of(DIFFERENCES, f"−{limit:.2f} m", f"+{limit:.2f} m"),
        "line": describe(figures),
    }


def _registration(found: dict[str, Any]) -> list[Headline]:
    """What is said of the model's place, with its standard uncertainty."""
    figures = (
        ("moved east", "east_m", "m"),
        ("moved north", "north_m", "m"),
        ("moved up", "up_m", "m"),
        ("tilt along east", "tilt_east_m_per_km", "m/km"),
        ("tilt along north", "tilt_north_m_per_km", "m/km"),
    )
    cards = []
    for title, name, unit in figures:
        sigma = found[f"sigma_{name}"]
        note = "" if sigma is None else f"± {sigma:.3f} {unit}"
        cards.append(Headline(title, minus(f"{found[name]:+.3f} {unit}"), note))
    return cards
