"""Disparities of a synthetic scene against its exact truth.

The truth lies on the same grid, from rays through the centres of its pixels
(:mod:`stereotruth.evaluate.epipolar_truth`), so labels are compared with it pixel by pixel.
Everything is done in blocks of the grid.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job import progress
from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.statistics import LIMITS, Calibration, ErrorSum
from ..core.products.files import write_json, write_table
from ..core.products.grids import blocks, open_grid
from ..core.products.rasters import read_tile
from ..core.status import Status
from ..tiles.manifest import Tile, labelled_tiles

log = logging.getLogger("stereotruth")
Flags = NDArray[np.uint8]


BLOCK = 1024  # px
# Classes of pixels: the truth's surfaces by number, and what lies beside height edges.
CLASSES = ("none", "ground", "roof", "wall", "tree", "water", "roof_edge", "tree_edge")
GROUND, ROOF, WATER, ROOF_EDGE, TREE_EDGE = (
    CLASSES.index(name) for name in ("ground", "roof", "water", "roof_edge", "tree_edge")
)
UNCHANGED, IN_LIDAR_ONLY, IN_IMAGES_ONLY = range(3)
GROUPS = ("visible", "hidden", "in_lidar_only", "in_images_only", "visible_lost", "hidden_bared")
SHARES = tuple(f"share_of_{group}_labelled" for group in GROUPS[:4])
MEANING = {
    "errors": "label less true disparity, px; labelled pixels of the group visible",
    "y_parallax": "y of the true right position less y of the left one, px; all pixels of the "
    "group visible, with or without label",
    "calibration": "errors against the uncertainty stated for them: shares of |error| below one "
    "and two uncertainties, as a whole and by deciles of the uncertainty (px)",
    "visible": "pixels that both views see, inside the LiDAR's coverage, unchanged, no water (the "
    "surface water: water, but for that)",
    "hidden": "pixels of the left image that another surface hides from the right view, inside "
    "the right frame and the LiDAR's coverage, unchanged, no water",
    "in_lidar_only": "pixels that would show a building that exists in the LiDAR only",
    "in_images_only": "pixels that show a building that exists in the images only",
    "visible_lost": "of the visible ones, those hidden from the right view by a building that "
    "exists in the LiDAR only",
    "hidden_bared": "of the hidden ones, those hidden by a building that exists in the images only",
    "status": "pixels of each group by their status",
    "surfaces": "by what the pixel shows; roof_edge: roof or ground within 1 px of a step of more "
    "than 1 px of disparity at a roof or wall; tree_edge: ground beside any other such step",
}


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth in a window of the left epipolar grid; arrays [h, w].

    ``disparity`` (x_left − x_right) and ``y_parallax`` (y_right − y_left) float64 px, NaN where
    the left image shows nothing; ``visible``: seen in the right view; ``hidden``: inside the right
    frame, but not seen; ``changed``, ``changed_right``, ``covered``: see grid_truth; ``kind``:
    index into CLASSES.
    """

    disparity: Floats
    y_parallax: Floats
    visible: Flags
    hidden: Flags
    changed: Flags
    changed_right: Flags
    covered: Flags
    kind: Flags

    @classmethod
    def read(cls, store: xr.Dataset, rows: slice, cols: slice) -> Truth:
        """The truth in a window [rows, cols]."""
        window = store.isel(y=rows, x=cols)
        flags = ("visible", "hidden", "changed", "changed_right", "covered")
        surface, edge = window["surface"].values, window["edge"].values
        kind = surface.copy()
        kind[((surface == GROUND) | (surface == ROOF)) & (edge == 1)] = ROOF_EDGE
        kind[(surface == GROUND) & (edge == 2)] = TREE_EDGE
        return cls(
            *(window[name].values.astype(np.float64) for name in ("disparity", "y_parallax")),
            *(window[name].values for name in flags),
            kind=kind,
        )

    def groups(self) -> dict[str, Bools]:
        """Masks [h, w] of the pixels of GROUPS, see MEANING; ``visible`` has water, too."""
        steady = (self.covered == 1) & (self.changed == UNCHANGED)
        seen, hidden = steady & (self.visible == 1), steady & (self.hidden == 1)
        shown = (self.covered == 1) & (self.kind > 0)
        masks = (
            seen,
            hidden,
            shown & (self.changed == IN_LIDAR_ONLY),
            shown & (self.changed == IN_IMAGES_ONLY),
            seen & (self.changed_right == 1),
            hidden & (self.changed_right == 1),
        )
        return dict(zip(GROUPS, masks))


class Labels(NamedTuple):
    """Labels in a window; arrays [h, w].

    ``disparity`` and its standard ``uncertainty`` float64 px, NaN where there is none; ``status``
    as in the disparity store.
    """

    disparity: Floats
    status: Flags
    uncertainty: Floats

    @classmethod
    def read(cls, store: xr.Dataset, rows: slice, cols: slice) -> Labels:
        """The labels of a disparity store in a window [rows, cols]."""
        window = store.isel(y=rows, x=cols)
        disparity, status, uncertainty = (window[name].values for name in cls._fields)
        return cls(disparity.astype(np.float64), status, uncertainty.astype(np.float64))


@dataclass
class Comparison:
    """Figures of labels against the truth; see ``MEANING``.

    ``counts``: pixels by group and status.
    """

    labels: int = 0
    errors: ErrorSum = field(default_factory=ErrorSum)
    calibration: Calibration = field(default_factory=Calibration)
    parallax: ErrorSum = field(default_factory=ErrorSum)
    counts: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros((len(GROUPS), len(Status)), np.int64)
    )

    def merge(self, other: Comparison) -> None:
        """Add the figures of other pixels."""
        self.labels += other.labels
        self.errors.merge(other.errors)
        self.calibration.merge(other.calibration)
        self.parallax.merge(other.parallax)
        self.counts += other.counts

    def figures(self) -> dict[str, Any]:
        """JSON-ready; px and shares 0 … 1 (null where there are no such pixels)."""
        pixels = dict(zip(GROUPS, self.counts.sum(axis=1).tolist()))
        has_label = [status for status in Status if status.carries_label]
        labelled = dict(zip(GROUPS, self.counts[:, has_label].sum(axis=1).tolist()))
        return {
            "labels": self.labels,
            "errors": self.errors.figures(),
            "calibration": self.calibration.figures(),
            "y_parallax": self.parallax.figures(),
            "pixels": pixels,
            "labelled": labelled,
            **{
                share: round(labelled[group] / pixels[group], 6) if pixels[group] else None
                for share, group in zip(SHARES, GROUPS)
            },
            "status": {
                group: {status.label: n for status, n in zip(Status, row) if n}
                for group, row in zip(GROUPS, self.counts.tolist())
            },
        }


@dataclass
class ByClass:
    """Comparisons of the pixels of some windows, by class."""

    parts: dict[str, Comparison] = field(default_factory=dict)

    def merge(self, other: ByClass) -> None:
        """Add the figures of other pixels."""
        for name, part in other.parts.items():
            self.parts.setdefault(name, Comparison()).merge(part)

    @property
    def total(self) -> Comparison:
        """All classes but water."""
        result = Comparison()
        for name in self.classes:
            if name != "water":
                result.merge(self.parts[name])
        return result

    @property
    def classes(self) -> list[str]:
        """The classes that there are, in the order of CLASSES."""
        return [name for name in CLASSES if name in self.parts]

    def figures(self) -> dict[str, Any]:
        """JSON-ready: the total, and ``surfaces``."""
        surfaces = {name: self.parts[name].figures() for name in self.classes if name != "none"}
        return self.total.figures() | {"surfaces": surfaces}


@dataclass
class SceneComparison:
    """Figures of scenes: their whole grids, their exported tiles, and each tile."""

    name: str
    whole: ByClass = field(default_factory=ByClass)
    all_tiles: ByClass = field(default_factory=ByClass)
    tiles: dict[str, Comparison] = field(default_factory=dict)

    def merge(self, other: SceneComparison) -> None:
        """Add another scene."""
        self.whole.merge(other.whole)
        self.all_tiles.merge(other.all_tiles)
        self.tiles |= other.tiles

    def figures(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "name": self.name,
            "what": "disparities against the exact truth of synthetic scenes",
            "units": "px; shares 0 to 1",
            "meaning": MEANING,
            "whole_scene": self.whole.figures(),
            "exported_tiles": self.all_tiles.figures(),
            "tiles": {name: c.figures() for name, c in self.tiles.items()},
        }


def open_truth(path: str | Path, epipolar: Mapping[str, Any] | None = None) -> xr.Dataset:
    """The truth of a synthetic scene on its epipolar grid.

    Raises InputError if it is missing, unfinished, or of another epipolar model than ``epipolar``.
    """
    group = open_grid(path)
    if group.attrs.get("kind") != "truth":
        raise InputError("no truth store", file=path, remedy="run the rule grid_truth")
    if epipolar is not None and group.attrs["epipolar"] != epipolar:
        raise InputError(
            "truth on the grid of another epipolar model than the disparities'",
            file=path,
            remedy="run the workflow again",
        )
    return group


def compare(labels: Labels, truth: Truth) -> ByClass:
    """Labels against the truth of the same window."""
    labelled = np.isfinite(labels.disparity)
    groups = truth.groups()
    seen = groups["visible"]
    size = len(Status)
    index = truth.kind.astype(np.intp) * size + labels.status
    counts = np.stack(
        [np.bincount(index[group], minlength=size * len(CLASSES)) for group in groups.values()]
    ).reshape(len(GROUPS), len(CLASSES), size)
    good = seen & labelled
    stated = good & np.isfinite(labels.uncertainty)
    errors = labels.disparity - truth.disparity
    result = ByClass()
    for kind in np.unique(truth.kind):
        here = truth.kind == kind
        part = result.parts[CLASSES[kind]] = Comparison()
        part.labels = int((here & labelled).sum())
        part.errors.add(errors[good & here])
        part.calibration.add(errors[stated & here], labels.uncertainty[stated & here])
        part.parallax.add(truth.y_parallax[seen & here])
        part.counts += counts[:, kind]
    return result


def read_tile_labels(tiles: Path, tile: Tile, store: xr.Dataset) -> Labels:
    """Labels of an exported tile.

    Its right offset is added to the disparity, px of the scene's grid. The uncertainty, which is
    not exported, is that of the disparity store.
    """
    return Labels(
        read_tile(tiles / tile.row["disp"]) + tile.right_offset_px,
        np.nan_to_num(read_tile(tiles / tile.row["status"])).astype(np.uint8),
        store["uncertainty"][tile.window].values.astype(np.float64),
    )


def _mapped(work: Any, items: Sequence[Any], workers: int, what: str) -> Iterator[Any]:
    """work(item) of all items in their order, by threads."""
    with ThreadPoolExecutor(workers) as pool:
        yield from progress(pool.map(work, items), len(items), what)


def compare_scene(
    disparity: str | Path,
    truth: str | Path,
    tiles: str | Path | None,
    *,
    scene: str,
    workers: int = 1,
) -> SceneComparison:
    """Compare disparity.zarr, and the scene's tiles under ``tiles`` if given, with the truth.

    Raises InputError for missing, unfinished or unlike stores.
    """
    store = open_grid(disparity)
    true = open_truth(truth, store.attrs["epipolar"])

    def block(window: tuple[slice, slice]) -> ByClass:
        return compare(Labels.read(store, *window), Truth.read(true, *window))

    result = SceneComparison(scene)
    windows = blocks(store["disparity"].shape, BLOCK)
    for part in _mapped(block, windows, workers, f"{scene}: blocks compared"):
        result.whole.merge(part)
    if tiles is not None:
        folder = Path(tiles)

        def of_tile(tile: Tile) -> ByClass:
            here = Truth.read(true, *tile.window)
            return compare(read_tile_labels(folder, tile, store), here)

        found = labelled_tiles(folder, scene)
        done = _mapped(of_tile, found, workers, f"{scene}: tiles compared")
        for tile, part in zip(found, done):
            result.tiles[tile.name] = part.total
            result.all_tiles.merge(part)
    return result


def table_row(scope: str, comparison: Comparison) -> dict[str, Any]:
    """One line of the table."""
    figures = comparison.figures()
    errors, parallax = figures["errors"], figures["y_parallax"]
    return {
        "scope": scope,
        "labels": figures["labels"],
        "mean_absolute_px": errors["mean_absolute"],
        "median_px": errors["median"],
        "rms_px": errors["rms"],
        "nmad_px": errors["nmad"],
        **{f"share_over_{limit:g}_px": errors[f"share_over_{limit:g}_px"] for limit in LIMITS},
        **{share: figures[share] for share in SHARES},
        "y_parallax_rms_px": parallax["rms"],
        "y_parallax_mean_px": parallax["bias"],
        "y_parallax_max_px": parallax["max"],
        "share_below_1_uncertainty": figures["calibration"]["share_below_1"],
        "share_below_2_uncertainties": figures["calibration"]["share_below_2"],
    }


def table(result: SceneComparison) -> list[dict[str, Any]]:
    """The whole grid, all its tiles, both also by class, and each tile."""
    rows = []
    for scope, part in (("scene", result.whole), ("tiles", result.all_tiles)):
        if part.parts:
            rows.append(table_row(scope, part.total))
            rows += [
                table_row(f"{scope}: {name}", part.parts[name])
                for name in part.classes
                if name != "none"
            ]
    return rows + [table_row(f"tile {name}", c) for name, c in result.tiles.items()]


@dataclass(frozen=True)
class MadeScene:
    """Name and products of a scene: disparity store, truth on its grid, folder of tiles."""

    name: str
    disparity: Path
    truth: Path
    tiles: Path | None = None


def evaluate_truth(
    name: str,
    scenes: Sequence[MadeScene],
    json_file: str | Path,
    csv_file: str | Path,
    *,
    workers: int = 1,
    provenance: Mapping[str, Any] | None = None,
) -> SceneComparison:
    """Compare scenes with their truth, pooled under ``name``; write figures and table."""
    result = SceneComparison(name)
    for scene in scenes:
        result.merge(
            compare_scene(
                scene.disparity, scene.truth, scene.tiles, scene=scene.name, workers=workers
            )
        )
    write_table(csv_file, table(result), list(table_row("", Comparison())))
    write_json(json_file, result.figures() | {"provenance": dict(provenance or {})})
    shown = result.all_tiles if result.tiles else result.whole
    row = table_row("", shown.total)
    factors = {
        "mean_absolute_px": 1,
        "share_over_1_px": 100,
        "y_parallax_rms_px": 1,
        "share_of_visible_labelled": 100,
        "share_of_hidden_labelled": 100,
    }
    values = [np.nan if row[key] is None else row[key] * k for key, k in factors.items()]
    log.info(
        "%s: mean absolute error %.3f px, %.3f %% over 1 px; y-parallax %.3f px rms; %.1f %% of "
        "the visible and %.1f %% of the hidden pixels labelled",
        "tiles" if result.tiles else "scene",
        *values,
    )
    return result
