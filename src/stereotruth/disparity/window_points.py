"""The points of a window: by pixel, and as vertices over the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..surface.vertices import VertexBuilder, Vertices
from .image_patches import read_patch
from .local_projection import LocalProjection
from .pair_window import PairWindow
from .pixel_points import Collection, PixelPoints
from .point_windows import Box, Footprint
from .scene_inputs import SceneInputs

BLOCK = 1 << 16  # points that go through the projection at once, while they are in the cache


@dataclass(frozen=True, eq=False)
class WindowPoints:
    """The points of a window ``by_pixel``; the ``projection`` of all ground around; the
    ``vertices`` of the surface around, None with the recipe paper."""

    by_pixel: PixelPoints
    projection: LocalProjection
    vertices: Vertices | None


def read_window(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[PairWindow, WindowPoints] | None:
    """The images and points of a window of the left grid; None if it has no points."""
    footprint = scene.windows.footprint(rows, cols)
    if footprint is None:
        return None
    window = _window(scene, rows, cols, footprint)
    points = _points(scene, scene.windows.strips(rows, cols, footprint), window)
    return None if points is None else (window, points)


def _window(scene: SceneInputs, rows: slice, cols: slice, footprint: Footprint) -> PairWindow:
    """Of the left image, the window with its margin; of the right one, all that its points can be
    seen in."""
    margin, size = scene.settings.margin, scene.settings.images_window
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
    # A few pixels more, for what is not linear in between.
    there = slice(int(x_right.min(initial=0.0)) - 8, int(x_right.max(initial=0.0)) + 9)
    patches = read_patch(left, rows, cols, size), read_patch(right, rows, there, size)
    return PairWindow(rows, cols, margin, *patches)


def _points(scene: SceneInputs, strips: Sequence[Box], window: PairWindow) -> WindowPoints | None:
    """The points of some strips of the ground; None if none is in the window."""
    if not strips:
        return None
    box = [edge(strip[k] for strip in strips) for k, edge in enumerate((min, min, max, max))]
    heights = scene.windows.heights(box)
    if heights is None:
        return None
    low = [int(np.floor(edge / LATTICE_DEG)) for edge in box[:2]]
    high = [int(np.ceil(edge / LATTICE_DEG)) for edge in box[2:]]
    low_h, high_h = (round(height / LATTICE_M) for height in heights)
    projection = LocalProjection.of(scene.pair.model, (*low, low_h), (*high, high_h))
    collection = Collection(window.shape, window.first, (low[0], low[1]), window.left, window.right)
    vertices = None
    if scene.settings.on_surface:
        vertices = VertexBuilder(scene.scale.surface, (low[0], low[1]), (high[0], high[1]))
    for strip in strips:
        for store in scene.stores:
            points = store.query(*strip)
            for start in range(0, len(points), BLOCK):
                block = slice(start, start + BLOCK)
                lattice = points.lon_q[block], points.lat_q[block], points.h_q[block]
                classes = points.classification[block]
                collection.add(*lattice, classes, projection.at_points(*lattice))
                if vertices is not None:
                    vertices.add(*lattice, classes, points.return_number[block])
    by_pixel = collection.sorted()
    if by_pixel.points.size == 0 and not by_pixel.outside.any():
        return None
    return WindowPoints(by_pixel, projection, None if vertices is None else vertices.built())
