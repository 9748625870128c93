"""Pictures of a city's tiles: coverage (figure 7 of the paper) and contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from ..core.errors import in_number
from ..core.products.rasters import read_disparity, read_image
from ..core.status import BY_LABEL
from ..pages import pictures
from ..pages.pictures import colours, save_figure

Picture = NDArray[np.uint8]


CONTACT_TILES = 16  # most tiles on the contact sheet
LINE_IN = 2.0  # inches of a line of them
GAP_PX = 36  # between them, for what they are called


def draw_coverage(
    path: Path, city: str, rows: Sequence[Mapping[str, Any]], scans: Mapping[str, tuple]
) -> None:
    """Where a city's tiles lie; ``scans``: grey picture, mask and scale by scene."""
    scenes = [
        (scene, pictures.stretch(picture), mask, float(scale))
        for scene, (picture, mask, scale) in scans.items()
    ]
    tiles = [
        (r["scene"], r["row0"], r["col0"], r["size"], r["split"], r["complete"] == "yes")
        for r in rows
    ]
    count = sum(tile[5] for tile in tiles)
    more = f"{len(tiles) - count} without complete labels"
    title = f"{city}: {in_number(count, 'labelled pair')}, {more}"
    coverage_figure(path, title, scenes, tiles)


def draw_contact_sheet(
    path: Path, city: str, rows: Sequence[Mapping[str, Any]], folder: Path, nodata: float
) -> None:
    """Some of a city's labelled pairs, evenly drawn from all."""
    labelled = [row for row in rows if row["complete"] == "yes"]
    picked = np.unique(np.linspace(0, len(labelled) - 1, CONTACT_TILES).round().astype(int))
    tiles = []
    for row in (labelled[k] for k in picked):
        images = (read_image(folder / row[kind]) for kind in ("left", "right"))
        grey = [pictures.stretch(pictures.shrink(image, 256)) for image in images]
        step = max(1, row["size"] // 256)
        disparity = read_disparity(folder / row["disp"], nodata)[::step, ::step]
        tiles.append((row["tile"], *grey, disparity))
    values = np.concatenate([tile[3][np.isfinite(tile[3])] for tile in tiles])
    limits = tuple(float(v) for v in np.percentile(values, (1, 99)))
    title = f"{city}: {len(tiles)} of {len(labelled)} labelled pairs"
    contact_sheet(path, title, tiles, limits)


STATUS_COLOURS_FILE = "status_colours.txt"
SPLIT_COLOURS = {"train": "#0072b2", "val": "#e69f00", "test": "#6f0952", "none": "#8a8a8a"}


def status_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour, #rrggbb, for each reason; reasons that are not known get one of their own."""
    known = {name: BY_LABEL[name].colour for name in names if name in BY_LABEL}
    unknown = [name for name in names if name not in known]
    other = {name: pictures.SERIES[k % len(pictures.SERIES)] for k, name in enumerate(unknown)}
    return known | other


def write_status_colours(path: Path, flags: Mapping[int, str]) -> None:
    """The colours of status values as a colour map of QGIS: value, R, G, B, A, meaning by lines.

    It stands beside the tiles: some readers give colours, not values, of a TIFF with a table.
    """
    colours = status_colours(list(flags.values()))
    lines = ["INTERPOLATION:EXACT"]
    for value, name in flags.items():
        red, green, blue = bytes.fromhex(colours[name][1:])
        lines.append(f"{value},{red},{green},{blue},255,{name.replace('_', ' ')}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def coverage_figure(
    path: str | Path,
    title: str,
    scenes: Sequence[tuple[str, Picture, NDArray[np.bool_], float]],
    tiles: Sequence[tuple[str, int, int, int, str, bool]],
) -> None:
    """Where the tiles of a city lie (figure 7 of the paper), one panel per scene.

    ``scenes``: (scene, grey picture of the rectified left image, labelled mask of the same
    shape, px of the epipolar grid per px of the picture). ``tiles``: (scene, row0, col0, size in
    px of the epipolar grid, split, complete).
    """
    tallest = max(grey.shape[0] / grey.shape[1] for _, grey, _, _ in scenes)
    figure = Figure(figsize=(7.0 * len(scenes), 6.2 * tallest + 1.4), layout="constrained")
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axis, (scene, grey, labelled, scale) in zip(axes, scenes):
        picture = np.repeat(grey[..., None], 3, axis=2)
        tint = np.array([40, 110, 255], np.float32)
        picture[labelled] = (0.6 * picture[labelled] + 0.4 * tint).astype(np.uint8)
        rows, cols = grey.shape
        axis.imshow(picture, extent=(-0.5, cols * scale - 0.5, rows * scale - 0.5, -0.5))
        for where, row0, col0, size, split, complete in tiles:
            if where != scene:
                continue
            inset = size / 80  # neighbours do not hide each other's colour
            corner, side = (col0 - 0.5 + inset, row0 - 0.5 + inset), size - 2 * inset
            if complete:  # a white casing, below the frames of all tiles
                axis.add_patch(
                    Rectangle(corner, side, side, fill=False, linewidth=3.6, edgecolor="w")
                )
            axis.add_patch(
                Rectangle(
                    corner,
                    side,
                    side,
                    fill=False,
                    linewidth=1.8 if complete else 1.0,
                    linestyle="-" if complete else "--",
                    edgecolor=SPLIT_COLOURS[split] if complete else "0.75",
                    zorder=3 if complete else 2,
                )
            )
        axis.set(title=scene, xlabel="x in px of the epipolar grid", ylabel="y in px")
    legend = [Patch(fill=False, edgecolor=colour, label=s) for s, colour in SPLIT_COLOURS.items()]
    legend.append(Patch(fill=False, edgecolor="0.75", linestyle="--", label="incomplete pair"))
    legend.append(Patch(color=(0.45, 0.62, 1.0), label="labelled"))
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    figure.suptitle(title)
    save_figure(path, figure)


def contact_sheet(
    path: str | Path,
    title: str,
    tiles: Sequence[tuple[str, Picture, Picture, NDArray[np.floating]]],
    limits: tuple[float, float],
) -> None:
    """Tiles of a city: left, right and disparity in colour, two tiles to a line.

    ``tiles``: (caption, left, right, disparity in px with NaN), all small already.
    """
    lines = -(-len(tiles) // 2)
    side = max(max(grey.shape) for _, grey, _, _ in tiles)
    step = side + GAP_PX
    # one picture of all: an axis for each would take most of the time
    sheet = np.full((lines * step, 6 * step, 3), 255, np.uint8)
    inches = LINE_IN * lines
    figure = Figure(figsize=(13.0, inches + 0.8))
    height = figure.get_figheight()
    axis = figure.add_axes((0.01, 0.05 / height, 6 * LINE_IN / 13.0, inches / height))
    for k, (caption, left, right, disparity) in enumerate(tiles):
        row = k // 2 * step + GAP_PX
        trio = (np.atleast_3d(left), np.atleast_3d(right), colours(disparity, limits))
        for n, (picture, name) in enumerate(zip(trio, (f"{caption}, left", "right", "disparity"))):
            col = (3 * (k % 2) + n) * step
            high, wide = picture.shape[:2]
            sheet[row : row + high, col : col + wide] = picture
            axis.text(col + side / 2, row - 4, name, fontsize=8, ha="center", va="bottom")
    axis.imshow(sheet)
    axis.set_axis_off()
    mappable = ScalarMappable(cmap=pictures.DISPARITIES)
    mappable.set_clim(*limits)
    scale = figure.add_axes((0.94, 0.05 / height, 0.012, (inches - 0.3) / height))
    figure.colorbar(mappable, cax=scale, label="disparity, px (offset removed)")
    figure.suptitle(title, y=1 - 0.25 / height)
    save_figure(path, figure)
