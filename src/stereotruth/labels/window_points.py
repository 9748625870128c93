"""The points of a window by pixel, and what it may see of the surface over the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..lidar.smooth_maps import LocalProjection
from ..surface.surface_store import WindowSurface
from .image_patches import read_patch
from .pair_window import PairWindow
from .pixel_points import Collection, PixelPoints
from .point_windows import Box, Footprint
from .scene_inputs import SceneInputs
from .shifted_agreement import SHIFTED_PX

BLOCK = 1 << 16  # points that go through the projection at once, while they are in the cache


@dataclass(frozen=True, eq=False)
class WindowPoints:
    """The points of a window ``by_pixel``; the ``projection`` of all ground around; the
    ``surface`` around, None with the recipe paper."""

    by_pixel: PixelPoints
    projection: LocalProjection
    surface: WindowSurface | None


def read_window(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[PairWindow, WindowPoints] | None:
    """The images and points of a window of the left grid; None if it has no points."""
    footprint = scene.windows.footprint(rows, cols)
    if footprint is None:
        return None
    window = _window(scene, rows, cols, footprint)
    surface = None
    if blocks := scene.surface_blocks(rows, cols):
        surface = scene.ground.window(blocks)
    elif scene.on_surface:
        return None
    points = _points(scene, scene.windows.strips(rows, cols, footprint), window, surface)
    return None if points is None else (window, points)


def _window(scene: SceneInputs, rows: slice, cols: slice, footprint: Footprint) -> PairWindow:
    """Of the left image, the window with its margin; of the right one, all that its points can be
    seen in."""
    margin, size = scene.margin, scene.images_window
    rows = slice(rows.start - margin, rows.stop + margin)
    cols = slice(cols.start - margin, cols.stop + margin)
    x, y, height = (
        grid.reshape(-1)
        for grid in np.meshgrid(
            np.linspace(cols.start - 1.0, cols.stop, 5),
            np.linspace(rows.start - 1.0, rows.stop, 5),
            [footprint.low, footprint.high],
        )
    )
    model, (left, right) = scene.pair.model, scene.pair.images
    x_right = model.ground_to_epipolar(*model.epipolar_to_ground(x, y, height), height)[2]
    x_right = x_right[np.isfinite(x_right)]
    # A few pixels more, for what is not linear in between, and what shifted disparities show.
    more = 8 + SHIFTED_PX
    there = slice(int(x_right.min(initial=0.0)) - more, int(x_right.max(initial=0.0)) + more + 1)
    patches = read_patch(left, rows, cols, size), read_patch(right, rows, there, size)
    return PairWindow(rows, cols, margin, *patches)


def _points(
    scene: SceneInputs, strips: Sequence[Box], window: PairWindow, surface: WindowSurface | None
) -> WindowPoints | None:
    """The points of some strips of the ground; None if none is in the window."""
    if not strips:
        return None
    box = [edge(strip[k] for strip in strips) for k, edge in enumerate((min, min, max, max))]
    heights = scene.windows.heights(box)
    if heights is None:
        return None
    origin = int(np.floor(box[0] / LATTICE_DEG)), int(np.floor(box[1] / LATTICE_DEG))
    low = [*origin, round(heights[0] / LATTICE_M)]
    high = [*(int(np.ceil(edge / LATTICE_DEG)) for edge in box[2:]), round(heights[1] / LATTICE_M)]
    if surface is not None:
        vertices = surface.vertices
        lattice = vertices.lon_q, vertices.lat_q, vertices.h_q
        low = [min(q, int(values.min())) for q, values in zip(low, lattice)]
        high = [max(q, int(values.max())) for q, values in zip(high, lattice)]
    projection = LocalProjection.of(scene.pair.model, low, high)
    collection = Collection(window.shape, window.first, origin, window.left, window.right)
    for strip in strips:
        for store in scene.stores:
            points = store.query(*strip)
            for start in range(0, len(points), BLOCK):
                block = slice(start, start + BLOCK)
                lattice = points.lon_q[block], points.lat_q[block], points.h_q[block]
                attributes = points.classification[block], scene.day_numbers[points.day[block]]
                collection.add(*lattice, *attributes, projection.at_points(*lattice))
    by_pixel = collection.sorted()
    if by_pixel.points.size == 0 and not by_pixel.outside.any():
        return None
    return WindowPoints(by_pixel, projection, surface)
