"""The labels of one window of the left epipolar grid, and why its other pixels have none.

With the recipe ``surface``, the surface of the points tells what each pixel's centre shows and what
hides it in either view (:mod:`.surface_between`). A pixel whose own points on the surface that its
centre sees (:func:`.seen_surface.seen_surface`) agree with it is measured, others are between
points. Then: do the images agree with what the LiDAR has XX
With the recipe ``paper`` labels are those of :mod:`.paper_recipe`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..epipolar.surface_correlation import surface_correlation
from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from .crowns import Crowns, crowns
from .ground_in_view import GroundInView
from .image_agreement import Agreement, apart_from_steps, warp_to_left
from .image_patches import USABLE, Patch, read_patch
from .local_projection import LocalProjection
from .paper_recipe import paper_labels
from .pixel_labels import Labels, Pixels, at_centres, condense
from .pixel_points import Collection, PixelPoints
from .point_windows import Box, Reach
from .scene_inputs import SceneInputs
from .seen_surface import MAX_COVER_PX, seen_surface
from .smooth_triangles import ground_surface
from .status import WATER_CLASS, Status, is_labelled
from .surface_between import between_labels, surface_between, usable_at
from .vertices import VertexBuilder, Vertices

Floats = NDArray[np.float64]
Window = tuple[slice, slice]


BLOCK = 1 << 16  # points that go through the projection at once, while they are in the cache
DENSE = 2.0  # points in a pixel, that miss nothing of a pixel's size


def label_window(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[dict[str, NDArray], NDArray[np.int64]] | None:
    """All layers of a window and its point counts; None if it has no points.

    Counts: points in the window, in both frames, used.
    """
    reach = scene.windows.reach(rows, cols)
    if reach is None:
        return None
    settings, margin = scene.settings, scene.settings.margin
    wide = (
        slice(rows.start - margin, rows.stop + margin),
        slice(cols.start - margin, cols.stop + margin),
    )
    left, right = _patches(scene, wide, reach)
    found = _collect(scene, scene.windows.strips(rows, cols, reach), wide, left, right)
    if found is None:
        return None
    points, local, vertices = found
    if vertices is not None:
        return _on_surface(scene, points, local, vertices, left, right, wide)
    model, px_per_m = scene.pair.model, scene.rays.px_per_m
    pixels, labels, status = paper_labels(settings, model, points, left, right, px_per_m)
    layers = _layers(scene, pixels, labels, pixels.correlation, status, wide)
    return layers, _counts(points, pixels, status, margin)


def _on_surface(
    scene: SceneInputs,
    points: PixelPoints,
    local: LocalProjection,
    vertices: Vertices,
    left: Patch,
    right: Patch,
    wide: Window,
) -> tuple[dict[str, NDArray], NDArray[np.int64]]:
    """As :func:`label_window`, by the recipe surface."""
    settings, px_per_m = scene.settings, scene.rays.px_per_m
    first = wide[0].start, wide[1].start
    use, edge = seen_surface(points, settings.edge_margin_px)
    pixels = condense(points, use, lambda sums, _: local.at_means(sums))
    own = at_centres(pixels, pixels.count >= settings.min_points, first, px_per_m)
    cell = scene.rays.cell
    view = GroundInView.of(vertices, scene.scale.width, local, first, points.shape, cell)
    surface = ground_surface(vertices, scene.scale, px_per_m, cell, view)
    between = surface_between(surface, local, first, points.shape, px_per_m)
    # less than two distances of points around a hidden one are looked at for what covers it
    porous = scene.scale.distance_px > MAX_COVER_PX / 2.0
    labels, status = between_labels(between, own, left, right, first, porous)
    status[(status == Status.NO_POINTS) & (points.count > 0)] = Status.EDGE_IN_PIXEL
    if settings.edge_margin_px > 0.0:
        status[is_labelled(status) & edge] = Status.EDGE_IN_PIXEL
    measured = status == Status.LABELLED
    pixels = replace(
        pixels,
        count=np.where(measured, pixels.count, 0),
        highest=np.where(measured, pixels.highest, between.height),
        surface_class=np.where(measured, pixels.surface_class, between.surface_class),
    )
    agreement = _test_agreement(scene, labels, pixels, status, left, right, wide)
    found = crowns(surface, between, local, first, scene.scale, px_per_m)
    if settings.edge_margin_px > 0.0:
        found = replace(found, shown=found.shown & ~edge)
    labels, pixels, agreement = _with_crowns(
        scene, found, labels, pixels, agreement, status, left, right, wide
    )
    layers = _layers(scene, pixels, labels, agreement, status, wide)
    return layers, _counts(points, pixels, status, settings.margin)


def _with_crowns(
    scene: SceneInputs,
    found: Crowns,
    labels: Labels,
    pixels: Pixels,
    agreement: Floats,
    status: NDArray[np.uint8],
    left: Patch,
    right: Patch,
    wide: Window,
) -> tuple[Labels, Pixels, Floats]:
    """Labels, pixels and correlation with those of rough surfaces; sets these in ``status``.

    Labels of other statuses stay as they are: crowns are held against the images by themselves.
    """
    row, col = np.nonzero(found.shown & (status == Status.EDGE_IN_PIXEL))
    x = col + wide[1].start
    match = np.floor(x - found.disparity[row, col]).astype(np.int64)
    both = usable_at(left, row + wide[0].start, x) & usable_at(right, row + wide[0].start, match)
    at = row[both == USABLE], col[both == USABLE]
    new = np.zeros(status.shape, np.bool_)
    new[at] = True
    merged = Labels(
        np.where(new, found.disparity, labels.disparity),
        np.where(new, found.slope, labels.slope),
        np.where(new, found.variance, labels.variance),
    )
    if at[0].size:
        held = _agreement(scene, merged, left, right, wide)
        agreement = np.where(new, held.correlation, agreement)
        changed = new & held.outvoted()
        status[changed] = Status.CHANGED
        new &= ~changed
    status[new] = Status.LABELLED_CROWN
    return (
        merged,
        replace(
            pixels,
            highest=np.where(new, found.height, pixels.highest),
            surface_class=np.where(new, found.surface_class, pixels.surface_class),
        ),
        agreement,
    )


def _patches(scene: SceneInputs, wide: Window, reach: Reach) -> tuple[Patch, Patch]:
    """Of the left image, the window; of the right one, all that its points can be seen in."""
    x, y, height = (
        grid.reshape(-1)
        for grid in np.meshgrid(
            np.linspace(wide[1].start - 1.0, wide[1].stop, 5),
            np.linspace(wide[0].start - 1.0, wide[0].stop, 5),
            [reach.low, reach.high],
        )
    )
    model, (left, right) = scene.pair.model, scene.pair.images
    x_right = model.ground_to_epipolar(*model.epipolar_to_ground(x, y, height), height)[2]
    x_right = x_right[np.isfinite(x_right)]
    # A few pixels more, for what is not linear in between.
    cols = slice(int(x_right.min(initial=0.0)) - 8, int(x_right.max(initial=0.0)) + 9)
    window = scene.settings.images_window
    return read_patch(left, *wide, window), read_patch(right, wide[0], cols, window)


def _collect(
    scene: SceneInputs, strips: Sequence[Box], wide: Window, left: Patch, right: Patch
) -> tuple[PixelPoints, LocalProjection, Vertices | None] | None:
    """The points of a window by pixel, and the vertices of the surface around; None if none."""
    if not strips:
        return None
    box = [step(strip[k] for strip in strips) for k, step in enumerate((min, min, max, max))]
    heights = scene.windows.heights(box)
    if heights is None:
        return None
    low = [int(np.floor(edge / LATTICE_DEG)) for edge in box[:2]]
    high = [int(np.ceil(edge / LATTICE_DEG)) for edge in box[2:]]
    shape = wide[0].stop - wide[0].start, wide[1].stop - wide[1].start
    low_h, high_h = (round(height / LATTICE_M) for height in heights)
    local = LocalProjection.of(scene.pair.model, (*low, low_h), (*high, high_h))
    first = wide[0].start, wide[1].start
    collection = Collection(shape, first, (low[0], low[1]), left, right)
    vertices = None
    if scene.settings.on_surface:
        vertices = VertexBuilder(scene.rays, (low[0], low[1]), (high[0], high[1]))
    for strip in strips:
        for store in scene.stores:
            points = store.query(*strip)
            for start in range(0, len(points), BLOCK):
                where = slice(start, start + BLOCK)
                lattice = points.lon_q[where], points.lat_q[where], points.h_q[where]
                classes = points.classification[where]
                collection.add(*lattice, classes, local.at_points(*lattice))
                if vertices is not None:
                    vertices.add(*lattice, classes, points.return_number[where])
    points = collection.sorted()
    if points.points.size == 0 and not points.outside.any():
        return None
    return points, local, None if vertices is None else vertices.built()


def _test_agreement(
    scene: SceneInputs,
    labels: Labels,
    pixels: Pixels,
    status: NDArray[np.uint8],
    left: Patch,
    right: Patch,
    wide: Window,
) -> Floats:
    """Correlation of the images over each pixel's surface; sets what has changed in status."""
    agreement = _agreement(scene, labels, left, right, wide)
    changed = agreement.outvoted()
    rim = agreement.beside(changed)
    if scene.scale.points_per_px < DENSE:
        # Points far apart miss what is small: the pixels of one window are asked again.
        changed |= is_labelled(status) & agreement.outvoted_nearby()
    changed |= is_labelled(status) & rim
    changed |= is_labelled(status) & (pixels.surface_class == WATER_CLASS)
    status[changed] = Status.CHANGED
    return agreement.correlation


def _agreement(
    scene: SceneInputs, labels: Labels, left: Patch, right: Patch, wide: Window
) -> Agreement:
    """Of the images, by the labels of a window."""
    settings, (rows, cols) = scene.settings, labels.disparity.shape
    warped = warp_to_left(right, *wide, labels.disparity)
    top, side = wide[0].start - left.row, wide[1].start - left.col
    shown = left.pixels[top : top + rows, side : side + cols]
    surface = labels.disparity, labels.slope
    clear = apart_from_steps(labels.disparity)
    found = surface_correlation(shown, warped, *surface, settings.window, clear)
    return Agreement(found, *surface, settings.correlation_threshold, scene.scale.trust)


def _layers(
    scene: SceneInputs,
    pixels: Pixels,
    labels: Labels,
    correlation: Floats,
    status: NDArray[np.uint8],
    wide: Window,
) -> dict[str, NDArray]:
    """The layers of a window, without its margin."""
    margin = scene.settings.margin
    inner = slice(margin, -margin), slice(margin, -margin)
    y, x = (np.arange(w.start + margin, w.stop - margin, dtype=np.float64) for w in wide)
    of_alignment = scene.pair.alignment_variance(x, y, labels.slope[:, *inner])
    variance = labels.variance[inner] + of_alignment
    values = {
        "disparity": labels.disparity[inner],
        "height": pixels.highest[inner],
        "correlation": correlation[inner],
        "uncertainty": np.sqrt(variance),
    }
    known = is_labelled(status[inner])
    result = {name: np.where(known, v, np.nan).astype(np.float32) for name, v in values.items()}
    kept = known | (status[inner] == Status.BELOW_MINIMUM_COUNT)
    count = np.where(kept, np.minimum(pixels.count[inner], 65535), 0)
    result["point_count"] = count.astype(np.uint16)
    result["surface_class"] = np.where(known, pixels.surface_class[inner], 0).astype(np.uint8)
    result["status"] = status[inner]
    return result


def _counts(
    points: PixelPoints, pixels: Pixels, status: NDArray[np.uint8], margin: int
) -> NDArray[np.int64]:
    """Points of a window without its margin: all, in both frames, used."""
    inner = (slice(margin, -margin),) * 2
    framed = points.count[inner].sum()
    outside = points.outside.reshape(points.shape)[inner].sum()
    labelled = np.isin(status[inner], (Status.LABELLED, Status.BELOW_MINIMUM_COUNT))
    used = pixels.count[inner][labelled].sum()
    return np.array([framed + outside, framed, used])
