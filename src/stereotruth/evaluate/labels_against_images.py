"""What the images say about a city's labels (section IV of the paper): table 4, image warping.

No truth is needed. SIFT matches were taken when the tiles were made
(:mod:`stereotruth.tiles.sift_matches`); they are read from their CSV file, summed up by class,
scene and tile, and drawn.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import binned_statistic_2d

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.numerics.statistics import ErrorSum
from ..core.products.files import read_table, write_table
from ..core.products.grids import blocks, open_grid, require_complete
from ..core.products.rasters import read_tile
from ..epipolar.warping import CorrelationSum, agreement, warp_window
from ..pages import pictures
from ..tiles.label_surfaces import BUILDING, VEGETATION
from ..tiles.manifest import Tile, read_manifest
from ..tiles.sift_matches import GROSS_PX
from ..tiles.tile_checks import warp_tile

BLOCK = 1024  # px of a grid, that are read at once
CELL_PX = 128  # of the maps of errors
CELL_MATCHES = 3  # fewer give no median
EXAMPLES = 3  # tiles in the figure of warped images
CODES = {
    "ground": (2,),
    "vegetation": (3, 4, 5),
    "building": (6,),
    "other": tuple(c for c in range(1, 256) if c not in range(2, 7)),
    "unknown": (0,),
}

TABLE4 = (
    "city",
    "pair_number",
    "matches_number",
    "mean_of_mean_disparity_errors_px",
    "mean_of_mean_absolute_disparity_errors_px",
    "gross_mismatches_share",
    "without_gross_mean_of_mean_disparity_errors_px",
    "without_gross_mean_of_mean_absolute_disparity_errors_px",
)
SIFT = (
    "scope",
    "name",
    "pairs",
    "matches",
    "mean_error_px",
    "mean_absolute_error_px",
    "median_error_px",
    "rms_error_px",
    "nmad_px",
)
WARPING = ("scope", "name", "class", "labelled_share", "pixels", "correlation")


class Matches(NamedTuple):
    """The matches of one tile: errors and y-parallax in px, position in the scene's grid in px."""

    tile: str
    scene: str
    kind: str
    error: Floats
    y_parallax: Floats
    x: Floats
    y: Floats
    surface_class: NDArray[np.uint8]


def read_matches(path: str | Path, tiles: Iterable[Tile]) -> Iterator[Matches]:
    """Matches of a CSV file of the export stage, tile by tile; ``tiles``: those of the manifest."""
    origin = {tile.name: (tile.col0, tile.row0) for tile in tiles}
    for name, lines in groupby(read_table(path), key=lambda line: line["tile"]):
        lines = list(lines)
        column = {
            name: np.array([float(line[name]) for line in lines])
            for name in ("x", "y", "y_right", "error_px", "surface_class")
        }
        col0, row0 = origin[name]
        yield Matches(
            tile=name,
            scene=lines[0]["scene"],
            kind=lines[0]["class"],
            error=column["error_px"],
            y_parallax=column["y_right"] - column["y"],
            x=column["x"] + col0,
            y=column["y"] + row0,
            surface_class=column["surface_class"].astype(np.uint8),
        )


@dataclass
class SceneWarping:
    """Sums of left and warped right image, and counts of pixels: labelled, in the left image."""

    sums: CorrelationSum = field(default_factory=CorrelationSum)
    labelled: int = 0
    imaged: int = 0

    def merge(self, other: SceneWarping) -> None:
        """Add those of other pixels."""
        self.sums.merge(other.sums)
        self.labelled += other.labelled
        self.imaged += other.imaged


def warp_scene(left: str | Path, right: str | Path, disparity: str | Path) -> SceneWarping:
    """Warp a scene, given as left.zarr, right.zarr and disparity.zarr, block by block.

    Raises InputError for unfinished stores.
    """
    left_image, right_image = (open_grid(path)["image"] for path in (left, right))
    labels = open_grid(disparity)["disparity"]
    if not left_image.shape == right_image.shape == labels.shape:
        raise InputError(
            "images and disparity differ in size", file=disparity, remedy="run project again"
        )
    total = SceneWarping()
    for rows, cols in blocks(labels.shape, BLOCK):
        values = labels[rows, cols].values.astype(np.float64)
        warped = warp_window(right_image, values, rows, cols)
        reference = left_image[rows, cols].values.astype(np.float64)
        labelled = int(np.isfinite(values).sum())
        total.merge(
            SceneWarping(agreement(reference, warped), labelled, int((reference != 0).sum()))
        )
    return total


def _mean(values: Sequence[float]) -> float | str:
    return round(float(np.mean(values)), 4) if values else ""


def table4_row(name: str, tiles: Sequence[Floats]) -> dict[str, Any]:
    """One line of table 4 from the errors (px) of each pair; pairs without a match do not count.

    The paper's figures use all matches. Beside them: the same without gross mismatches, errors more
    than ``GROSS_PX`` from the median of their pair.
    """
    tiles = [errors for errors in tiles if errors.size]
    fair = [e[np.abs(e - np.median(e)) <= GROSS_PX] for e in tiles]
    total, kept = (sum(e.size for e in group) for group in (tiles, fair))
    values = (
        name,
        len(tiles),
        total,
        _mean([e.mean() for e in tiles]),
        _mean([np.abs(e).mean() for e in tiles]),
        round(1 - kept / total, 6) if total else "",
        _mean([e.mean() for e in fair]),
        _mean([np.abs(e).mean() for e in fair]),
    )
    return dict(zip(TABLE4, values))


def _warping_row(scope: str, name: str, warped: SceneWarping) -> dict[str, Any]:
    share = round(warped.labelled / max(warped.imaged, 1), 6)
    coefficient = warped.sums.coefficient
    correlation = round(coefficient, 6) if np.isfinite(coefficient) else ""
    return dict(zip(WARPING, (scope, name, "", share, warped.sums.count, correlation)))


def evaluate_city(
    city: str,
    tiles: str | Path,
    matches: str | Path,
    scenes: Mapping[str, tuple[str | Path, str | Path, str | Path]],
    *,
    table4: str | Path,
    sift: str | Path,
    warping: str | Path,
    sift_figure: str | Path,
    warping_figure: str | Path,
) -> list[dict[str, Any]]:
    """Write the tables and figures of a city; the rows of table 4.

    ``tiles``: its folder; ``matches``: CSV file of the export stage; ``scenes``: left.zarr,
    right.zarr and disparity.zarr of each. Raises InputError for unfinished stores.
    """
    rows = [row for row in read_manifest(tiles) if row["complete"] == "yes"]
    by_kind: dict[str, list[Floats]] = {BUILDING: [], VEGETATION: []}
    sums: dict[tuple[str, str], ErrorSum] = {}
    pairs: dict[tuple[str, str], int] = {}
    maps = {scene: _Map(stores) for scene, stores in scenes.items()}

    def add(scope: str, name: str, errors: Floats) -> None:
        if errors.size:
            sums.setdefault((scope, name), ErrorSum()).add(errors)
            pairs[scope, name] = pairs.get((scope, name), 0) + 1

    for found in read_matches(matches, map(Tile.of, rows)):
        by_kind[found.kind].append(found.error)
        add("city", city, found.error)
        add("tiles of class", found.kind, found.error)
        for name, codes in CODES.items():
            add("key points on", name, found.error[np.isin(found.surface_class, codes)])
        add("scene", found.scene, found.error)
        add("tile", found.tile, found.error)
        maps[found.scene].add(found)
    order = ("city", "tiles of class", "key points on", "scene", "tile")
    table = [table4_row(f"{city} ({kind})", errors) for kind, errors in by_kind.items() if errors]
    write_table(table4, table, TABLE4)
    sift_rows = []
    for scope, name in sorted(sums, key=lambda key: order.index(key[0])):
        of = sums[scope, name].figures()
        keys = ("count", "bias", "mean_absolute", "median", "rms", "nmad")
        values = (scope, name, pairs[scope, name], *(of[key] for key in keys))
        sift_rows.append(dict(zip(SIFT, values)))
    write_table(sift, sift_rows, SIFT)
    by_scene = {scene: warp_scene(*stores) for scene, stores in scenes.items()}
    whole = SceneWarping()
    for warped in by_scene.values():
        whole.merge(warped)
    columns = ("tile", "class", "labelled_share", "count_labelled", "warp_correlation")
    tile_rows = [dict(zip(WARPING, ("tile", *(row[name] for name in columns)))) for row in rows]
    scene_rows = [_warping_row("scene", scene, warped) for scene, warped in by_scene.items()]
    write_table(warping, [_warping_row("city", city, whole), *scene_rows, *tile_rows], WARPING)
    _draw_sift(Path(sift_figure), city, by_kind, maps)
    _draw_warping(Path(warping_figure), city, Path(tiles), rows)
    return table


class _Map:
    """Errors and y-parallax of a scene's matches, by place."""

    def __init__(self, stores: Sequence[str | Path]) -> None:
        self.shape = require_complete(stores[0])["image"].shape
        self.parts: list[NDArray[np.float32]] = []

    def add(self, found: Matches) -> None:
        """Add a tile's."""
        values = (found.x, found.y, found.error, found.y_parallax)
        self.parts.append(np.stack(values).astype(np.float32))

    def medians(self) -> tuple[Floats, Floats]:
        """Median error and y-parallax (px) in cells of ``CELL_PX``, NaN for a few matches."""
        edges = [np.arange(-(-size // CELL_PX) + 1) * CELL_PX for size in self.shape]
        if not self.parts:
            error, y_parallax = np.full((2, *(of.size - 1 for of in edges)), np.nan)
            return error, y_parallax
        x, y, *values = np.hstack(self.parts)
        few = np.histogram2d(y, x, edges)[0] < CELL_MATCHES
        error, y_parallax = binned_statistic_2d(y, x, values, "median", edges).statistic
        return np.where(few, np.nan, error), np.where(few, np.nan, y_parallax)


def _draw_sift(
    path: Path, city: str, by_kind: Mapping[str, Sequence[Floats]], maps: Mapping[str, _Map]
) -> None:
    """Histogram of the errors by class, and where in each scene they lie."""
    figure = Figure(figsize=(13.0, 4.2 * (1 + len(maps))), layout="constrained")
    grid = figure.add_gridspec(1 + len(maps), 2)
    axis = figure.add_subplot(grid[0, :])
    bins = np.arange(-2.0, 2.001, 0.05)
    for kind, colour in zip((BUILDING, VEGETATION), pictures.SERIES):
        errors = np.concatenate([np.empty(0), *by_kind[kind]])
        if errors.size:
            outside = (np.abs(errors) > 2.0).mean()
            label = (
                f"tiles of class {kind}: {len(by_kind[kind])} pairs, {errors.size} matches, "
                f"median {np.median(errors):+.3f} px, {100 * outside:.2f} % beyond ±2 px"
            )
            weights = np.full(errors.size, 100.0 / errors.size)
            axis.hist(errors, bins, weights=weights, histtype="step", color=colour, label=label)
    axis.axvline(0.0, color="0.6", linewidth=0.8)
    axis.set(xlabel="SIFT disparity − label, px", ylabel="% of the matches in 0.05 px")
    if axis.get_legend_handles_labels()[0]:
        axis.legend(loc="upper left", fontsize=8)
    axis.set_title(f"{city}: SIFT matches against the labels")
    for line, (scene, found) in enumerate(maps.items(), start=1):
        rows, cols = found.shape
        for column, (values, title) in enumerate(
            zip(found.medians(), ("SIFT disparity − label", "y-parallax"))
        ):
            axis = figure.add_subplot(grid[line, column])
            axis.set_facecolor("0.85")
            extent = (0, -(-cols // CELL_PX) * CELL_PX, -(-rows // CELL_PX) * CELL_PX, 0)
            shown = axis.imshow(
                values, cmap=f"{pictures.DIFFERENCES}_r", vmin=-0.5, vmax=0.5, extent=extent
            )
            axis.set(xlabel="x in px of the epipolar grid", ylabel="y in px")
            axis.set_title(f"{scene}: {title}, median of {CELL_PX} × {CELL_PX} px", fontsize=10)
            figure.colorbar(shown, ax=axis, label="px")
    pictures.save_figure(path, figure)


def _draw_warping(path: Path, city: str, tiles: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Tiles of the lowest, the middle and the highest correlation (figure 9 of the paper)."""
    known = [row for row in rows if row["warp_correlation"]]
    ranked = sorted(known, key=lambda row: float(row["warp_correlation"]))
    picked = np.unique(np.linspace(0, len(ranked) - 1, EXAMPLES).round().astype(int))
    figure = Figure(figsize=(16.0, 3.7 * max(len(picked), 1)), layout="constrained")
    if not ranked:
        figure.text(0.5, 0.5, f"{city}: no tile that can be warped", ha="center")
        pictures.save_figure(path, figure)
        return
    axes = figure.subplots(len(picked), 5, squeeze=False)
    for line, row in zip(axes, (ranked[k] for k in picked)):
        tile = warp_tile(tiles, row)
        step = max(1, len(tile.left) // 512)
        limits = tuple(np.percentile(tile.left, (1, 99)))
        right = np.nan_to_num(read_tile(tiles / row["right"]))
        scaled = np.where(right > 0, tile.sums.match(right), np.nan)
        warped = tile.sums.match(tile.warped)
        difference = tile.left - warped
        spread = float(np.nanpercentile(np.abs(difference), 95))
        gray = {"cmap": "gray", "vmin": limits[0], "vmax": limits[1]}
        coloured = {"cmap": pictures.DIFFERENCES, "vmin": -spread, "vmax": spread}
        panels = (
            (tile.left, f"{tile.name} ({row['class']}): left", gray),
            (scaled, "right", gray),
            (tile.disparity, "disparity (px)", {"cmap": pictures.DISPARITIES}),
            (warped, f"warped right, r = {tile.correlation:.3f}", gray),
            (difference, "left − warped right", coloured),
        )
        for axis, (image, title, style) in zip(line, panels):
            axis.set_facecolor("black" if style is gray else np.array(pictures.NO_VALUE) / 255)
            axis.set(xticks=[], yticks=[])
            shown = axis.imshow(image[::step, ::step], interpolation="nearest", **style)
            axis.set_title(title, fontsize=9)
            if style is not gray:
                figure.colorbar(shown, ax=axis, shrink=0.8)
    figure.suptitle(f"{city}: right image warped to the left, brought to its brightness")
    pictures.save_figure(path, figure, dpi=90)
