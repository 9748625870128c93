"""The labels of one window of the left epipolar grid, and why its other pixels have none.

The recipe surface, step by step; equations and a figure: docs/explanation/surface.md. What the
LiDAR decides (:func:`lidar_labels`) follows from what lies close to a pixel, what the images decide
(:func:`image_layers`) from the labels around it and from no point.

1. *Facets.* The surface of the points has been made for all pairs of the site: facets, and
   triangles that are undecided (:mod:`stereotruth.surface.surface`). Those are taken that the
   window may see (:mod:`.window_points`).
2. *Visibility.* Facets and the prisms over undecided triangles are rasterised into the left view,
   and each pixel's position in the right image is tested against them
   (:mod:`stereotruth.surface.raster`). A pixel has the label of its nearest facet if nothing may
   hide it in either view; if its own points on this facet are the surer ones, theirs
   (:mod:`.pixel_labels`). Rough surfaces, of which no triangle is a facet, get labels of their own
   (:mod:`.crowns`).
3. *Agreement of the images.* Surfaces on which both images contradict the LiDAR have changed
   (:mod:`.change_probability`).
4. *Changes.* What has changed, by the LiDAR's classes and by the height at which the images agree
   (:mod:`.change_reasons`).
5. *Layers.* The labels with their uncertainty and status (:mod:`.layers`).

Steps return masks: the first status of :data:`.pair_window.PRECEDENCE` whose mask holds is that of
the pixel. Masks are merged four times: those of facets; of contours of rough surfaces; of crowns,
where an edge has left none; of changes, where there is a label. The recipe paper takes a pixel's
label from its own points alone (:mod:`.paper_recipe`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.status import Status, is_labelled
from ..lidar.point_store import WATER_CLASS
from ..sensor.image_noise import EQUAL
from ..surface.raster import ProjectedSurface
from .change_evidence import NO_NOISE, LabelledWindow, beyond_counts
from .change_probability import MEANS_PX, contradicted
from .change_reasons import REASON_PX, ChangedSurface, reasons_of
from .crowns import crowns, with_crowns, without_contours
from .layers import LidarLabels, layers_of
from .pair_window import MaskedImage, PairWindow, merged_status, read_patch
from .paper_recipe import paper_layers
from .pixel_labels import facet_labels, own_labels
from .scene_inputs import SceneInputs
from .shifted_agreement import SHIFTED_PX
from .window_points import ground_in_view

Counts = NDArray[np.int64]
Layers = dict[str, NDArray]


def label_window(scene: SceneInputs, rows: slice, cols: slice) -> tuple[Layers, Counts] | None:
    """All layers of a window by itself and its counts, see :func:`image_layers` and
    :func:`.paper_recipe.paper_layers`; None if it has no points."""
    if not scene.on_surface:
        return paper_layers(scene, rows, cols)
    around = labels_around(scene, rows, cols)
    return None if around is None else image_layers(scene, rows, cols, around)


def labels_around(scene: SceneInputs, rows: slice, cols: slice) -> LidarLabels | None:
    """What the LiDAR decides in a window and ``scene.image_margin`` px around it; None without a
    surface or points."""
    margin = scene.image_margin
    around = (slice(edge.start - margin, edge.stop + margin) for edge in (rows, cols))
    by_lidar = lidar_labels(scene, *around)
    return None if by_lidar is None else by_lidar[0]


def lidar_labels(scene: SceneInputs, rows: slice, cols: slice) -> tuple[LidarLabels, Counts] | None:
    """What the LiDAR decides in a window, and the numbers of its points, all and in both frames;
    None without a surface or points.

    It is cut into strips of rows, so that the surface of dense points is not in memory at once.
    """
    labels, counts = LidarLabels.none((rows.stop - rows.start, cols.stop - cols.start)), []
    for part in scene.windows.parts(rows, cols):
        of_part = _labels_of_part(scene, part, cols)
        if of_part is not None:
            counts.append(of_part[1])
            where = slice(part.start - rows.start, part.stop - rows.start)
            for values, new in zip(labels, of_part[0]):
                values[where] = new
    return (labels, np.sum(counts, axis=0)) if counts else None


def _labels_of_part(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[LidarLabels, Counts] | None:
    window_points = scene.windows.footprint(rows, cols)
    blocks = () if window_points is None else scene.surface_blocks(rows, cols)
    if not blocks:
        return None
    around = scene.ground.window(blocks)
    ground = scene.windows.ground(scene.windows.strips(rows, cols, window_points), around)
    if ground is None:
        return None
    window = scene.points_window(rows, cols, window_points)
    settings, scale, projection = scene.settings, scene.scale, ground.projection
    shape, first = window.shape, window.first

    # facets: over the ground that the window may see
    reach, cell = scale.surface.height_reach, scale.surface.cell
    region = ground_in_view(around.vertices, reach, cell, projection, first, shape)
    surface = around.surface(region)

    # visibility in both views; what each pixel's own points say
    projected = ProjectedSurface.of(surface, projection, first)
    seen = projected.seen(shape, scale.px_per_m).from_both_cameras()
    own = own_labels(ground.blocks(), window, seen, scale.px_per_m, settings.min_points)
    labels = facet_labels(seen, own, window, scale, scene.edge_margin_px)

    # rough surfaces
    rough = crowns(seen, scale, scene.edge_margin_px)
    labels = without_contours(labels, rough, seen, scale)
    is_rough = labels.status == Status.EDGE_IN_PIXEL
    labels = with_crowns(labels, rough, window).within(window.inner)
    in_frames = int(own.in_frames[window.inner].sum())
    counts = np.array([in_frames + own.outside, in_frames])
    if not counts.any():
        return None
    points = own.points.highest[window.inner], own.points.surface_class[window.inner]
    return LidarLabels.of(labels, is_rough[window.inner], *points), counts


def image_window(scene: SceneInputs, rows: slice, cols: slice, by_lidar: LidarLabels) -> PairWindow:
    """What both images show in a window, and around it as far as it has a say; the right one as far
    as the labels there can be seen in."""
    margin = scene.image_margin
    rows, cols = (slice(edge.start - margin, edge.stop + margin) for edge in (rows, cols))
    at = np.arange(cols.start, cols.stop) - by_lidar.disparity
    known = at[np.isfinite(at)]
    # A few pixels more, for what shifted disparities show.
    more = 8 + SHIFTED_PX
    least, most = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    there = slice(int(np.floor(least)) - more, int(np.ceil(most)) + more + 1)
    left, right = scene.pair.images
    return PairWindow(
        rows, cols, margin, read_patch(left, rows, cols, 1), read_patch(right, rows, there, 1)
    )


def image_layers(
    scene: SceneInputs, rows: slice, cols: slice, by_lidar: LidarLabels
) -> tuple[Layers, Counts]:
    """All layers of a window ``by_lidar``, whose labels reach ``scene.image_margin`` px farther, as
    far as images agree.

    Counts: points used; pixels of which the images were asked, and of these the ones beyond what
    was learned by each figure of the evidence.
    """
    window, labels = image_window(scene, rows, cols, by_lidar), by_lidar.labels
    # Reasons follow from changes up to REASON_PX off, these from probabilities up to MEANS_PX off,
    # and these from the agreement of the pixels beside. Labels farther off need no images.
    asked, inner = np.zeros((2, *window.shape), np.bool_)
    asked[window.grown(REASON_PX + MEANS_PX + 1)] = inner[window.inner] = True
    labelled = is_labelled(labels.status) & asked
    diachronic, classes = scene.settings.diachronic, labels.surface_class
    equal = window.of_equal_noise(scene.noise)
    compared = LabelledWindow(equal, labels.labels, labelled, classes, EQUAL)
    by_images = contradicted(compared, diachronic)
    changed = by_images.changed | labelled & (classes == WATER_CLASS)
    surface = ChangedSurface(
        changed, labels.height, classes, by_lidar.is_rough != 0, by_lidar.highest,
        by_lidar.highest_class,
    )  # fmt: skip
    change = reasons_of(surface, compared, scene.scale.px_per_m, diachronic)
    as_it_is = LabelledWindow(window, labels.labels, labelled & inner, classes, NO_NOISE)
    correlation, _ = as_it_is.correlation(scene.settings.window)

    with_unseen = replace(labels.labels, variance=labels.labels.variance + by_images.variance)
    labels = replace(labels, labels=with_unseen).within(window.inner)
    masks = {Status.CHANGED: changed[window.inner]}
    if isinstance(image := scene.pair.images[0], MaskedImage):
        masks[Status.MASKED] = image.mask[rows, cols] != 0
    labels = replace(labels, status=merged_status(masks, labels.status))
    by_both = correlation[window.inner], change[window.inner]
    used = labels.point_count[labels.status == Status.LABELLED].sum()
    counts = np.array([used, *beyond_counts(by_images.beyond[window.inner])])
    return layers_of(labels, *by_both, scene.pair, rows, cols), counts
