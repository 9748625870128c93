"""Pictures of disparity maps beside each other, after figure 10 of the paper.

All disparities of a figure have one colour scale, all errors another. What has no value is light
grey; in maps of errors, a labelled pixel without a disparity has a colour of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from stereotruth.pages.pictures import (
    DISPARITIES,
    ERRORS,
    NO_VALUE,
    colours,
    save_figure,
    shrink,
    stretch,
)

Disparity = NDArray[np.float32]
Picture = NDArray[np.uint8]


SIDE_PX = 400  # of a picture
INCHES, DPI = 3.2, 120
ERROR_PX = 6.0  # end of the scale of errors: twice the threshold of D1
INVALID = (60, 190, 255)
NAME_LETTERS = 18  # in a line of the names of rows


@dataclass(frozen=True)
class Column:
    """A pair with its truth (NaN: none) and the disparities of methods by their labels."""

    title: str
    left: NDArray[Any]
    right: NDArray[Any]
    truth: Disparity | None
    found: Mapping[str, Disparity]


def error_picture(found: Disparity, truth: Disparity) -> Picture:
    """Absolute errors in colour; unlabelled and invalid pixels in theirs."""
    picture = colours(np.abs(found - truth), (0.0, ERROR_PX), ERRORS)
    picture[np.isfinite(truth) & ~np.isfinite(found)] = INVALID
    return picture


def disparity_limits(columns: Sequence[Column]) -> tuple[float, float]:
    """A colour scale for the disparities of a figure: all but half a percent at either end."""
    values = []
    for column in columns:
        maps = list(column.found.values()) if column.truth is None else [column.truth]
        values += [of[np.isfinite(of)] for of in maps]
    pooled = np.concatenate(values) if values else np.zeros(0)
    if not pooled.size:
        return 0.0, 1.0
    low, high = np.percentile(pooled, (0.5, 99.5))
    return float(low), float(max(high, low + 1.0))


def draw_columns(path: str | Path, columns: Sequence[Column], *, across: bool = False) -> None:
    """PNG of pairs side by side: left, right, truth, every method, and the errors of every method.

    ``across``: pairs one below the other, and what belongs to a pair side by side.
    """
    limits = disparity_limits(columns)
    cells = [pictures_of(column, limits) for column in columns]
    methods = list(dict.fromkeys(name for column in columns for name in column.found))
    order = ["left", "right", "truth", *methods, *(f"error of {name}" for name in methods)]
    names = [name for name in order if any(name in of for of in cells)]
    grid = (len(columns), len(names)) if across else (len(names), len(columns))
    aspect = columns[0].left.shape[0] / columns[0].left.shape[1]
    size = INCHES if across else INCHES * 0.8
    beside, below = (1.6, 1.7) if across else (3.4, 0.8)  # inches, of names and scales
    figure = Figure(
        figsize=(size * grid[1] + beside, size * aspect * grid[0] + below), layout="compressed"
    )
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.02, wspace=0.0, hspace=0.0)
    axes = figure.subplots(*grid, squeeze=False)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    by_name = axes.T if across else axes
    for c, (column, of) in enumerate(zip(columns, cells)):
        for n, name in enumerate(names):
            axis = by_name[n, c]
            if name in of:
                axis.imshow(shrink(of[name], SIDE_PX), cmap="gray", vmin=0, vmax=255)
            if n == 0 if across else c == 0:  # level, so that a low row cuts nothing
                row = wrap(column.title if across else name, NAME_LETTERS)
                style = {"rotation": 0, "ha": "right", "va": "center", "fontsize": 9}
                axis.set_ylabel("\n".join(row), **style)
            if c == 0 if across else n == 0:
                axis.set_title(name if across else column.title, fontsize=9)
    _legend(figure, axes, names, limits, "bottom" if across else "right")
    save_figure(path, figure, dpi=DPI)


def pictures_of(column: Column, limits: tuple[float, float]) -> dict[str, Picture]:
    """Pictures of a pair by name, in the order of figure 10."""
    found = {
        name: image if image.ndim == 3 else stretch(image)
        for name, image in (("left", column.left), ("right", column.right))
    }
    if column.truth is not None:
        found["truth"] = colours(column.truth, limits)
    found |= {name: colours(of, limits) for name, of in column.found.items()}
    if column.truth is not None:
        for name, of in column.found.items():
            found[f"error of {name}"] = error_picture(of, column.truth)
    return found


def _legend(
    figure: Figure, axes: Any, names: Sequence[str], limits: tuple[float, float], where: str
) -> None:
    """Both scales, and what the other colours mean; ``names`` of the pictures."""
    has_errors = any(name.startswith("error of ") for name in names)
    scales = [(DISPARITIES, limits, "disparity, px", "both")]
    patches = [Patch(color=np.array(NO_VALUE) / 255, label="no value")]
    if has_errors:
        patches.append(Patch(color=np.array(INVALID) / 255, label="labelled, without disparity"))
        scales.append((ERRORS, (0.0, ERROR_PX), "absolute error, px", "max"))
    for cmap, ends, label, extend in scales:
        mappable = ScalarMappable(cmap=cmap)
        mappable.set_clim(*ends)
        figure.colorbar(
            mappable, ax=axes, location=where, label=label, extend=extend,
            fraction=0.05, aspect=30, shrink=0.6, pad=0.02,
        )  # fmt: skip
    figure.legend(handles=patches, loc="outside lower left", ncols=2, frameon=False, fontsize=8)
