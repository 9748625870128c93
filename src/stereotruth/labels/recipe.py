"""The labels of one window of the left epipolar grid, and why its other pixels have none.

The recipe surface, step by step; equations and a figure: docs/explanation/surface.md.

1. *Points.* The LiDAR's points are projected into both images and sorted by pixel
   (:mod:`.window_points`).
2. *Facets.* The surface of the points has been made for all pairs of the site: facets, and
   triangles that are undecided (:mod:`stereotruth.surface.surface`). Those are taken that the
   window may see (:mod:`.ground_in_view`).
3. *Visibility.* Facets and the prisms over undecided triangles are rasterised into the left view,
   and each pixel's position in the right image is tested against them
   (:mod:`stereotruth.surface.raster`). A pixel has the label of its nearest facet if nothing may
   hide it in either view; if its own points on this facet are the surer ones, theirs
   (:mod:`.pixel_labels`). Rough surfaces, of which no triangle is a facet, get labels of their own
   (:mod:`.crowns`).
4. *Agreement of the images.* Surfaces on which both images contradict the LiDAR have changed
   (:mod:`.change_probability`).
5. *Changes.* What has changed, by the LiDAR's classes and by the height at which the images agree
   (:mod:`.change_reasons`).
6. *Layers.* The labels with their uncertainty and status (:mod:`.layers`).

The recipe paper takes a pixel's label from its own points alone (:mod:`.paper_recipe`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.status import Status
from ..epipolar.image_noise import EQUAL
from ..surface.raster import ProjectedSurface
from .change_probability import MEANS_PX, Comparison, beyond_counts, without_changes
from .change_reasons import REASON_PX, with_reasons
from .crowns import Crowns, crowns, with_crowns, without_contours
from .ground_in_view import ground_in_view
from .layers import layers_of
from .pair_window import PairWindow, WindowLabels
from .paper_recipe import paper_labels
from .pixel_labels import OwnPoints, facet_labels, own_labels
from .scene_inputs import SceneInputs
from .window_points import WindowPoints, read_window


def label_window(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[dict[str, NDArray], NDArray[np.int64]] | None:
    """All layers of a window and its point counts; None if it has no points.

    Counts: points in the window, in both frames, used; pixels of which the images were asked, and
    of these the ones beyond what was learned by each figure of the evidence.
    """
    inputs = read_window(scene, rows, cols)
    if inputs is None:
        return None
    window, points = inputs
    recipe = surface_recipe if scene.on_surface else paper_recipe
    labels = recipe(scene, window, points).within(window.inner)
    layers = layers_of(labels, scene.pair, window)
    in_frames = points.by_pixel.count[window.inner]
    outside = points.by_pixel.outside.reshape(window.shape)[window.inner]
    of_points = labels.counts(in_frames, outside)
    return layers, np.concatenate([of_points, beyond_counts(labels.beyond)])


class LidarLabels(NamedTuple):
    """What the points say of a window, before its images are compared: ``labels`` of facets, the
    surfaces that are ``rough``, and each pixel's ``own`` points."""

    labels: WindowLabels
    rough: Crowns
    own: OwnPoints
    window: PairWindow


def lidar_labels(scene: SceneInputs, window: PairWindow, points: WindowPoints) -> LidarLabels:
    """Of a window, by the surface of the points around it."""
    settings, scale = scene.settings, scene.scale
    shape, first, projection = window.shape, window.first, points.projection

    # facets: over the ground that the window may see
    reach, cell = scale.surface.height_reach, scale.surface.cell
    around = points.surface
    region = ground_in_view(around.vertices, reach, cell, projection, first, shape)
    surface = around.surface(region)

    # visibility in both views; what each pixel's own points say
    projected = ProjectedSurface.of(surface, projection, first)
    seen = projected.seen(shape, scale.px_per_m).from_both_cameras()
    own = own_labels(points.by_pixel, seen, projection, scale.px_per_m, settings.min_points)
    labels = facet_labels(seen, own, window, scale, scene.edge_margin_px)

    # rough surfaces
    rough = crowns(seen, scale, scene.edge_margin_px)
    labels = without_contours(labels, rough, seen, scale)
    return LidarLabels(labels, rough, own.points, window)


def surface_recipe(scene: SceneInputs, window: PairWindow, points: WindowPoints) -> WindowLabels:
    """The labels of a window by the surface of the points around it, as far as images agree."""
    labels, rough, own, window = lidar_labels(scene, window, points)
    is_rough = labels.status == Status.EDGE_IN_PIXEL
    labels = with_crowns(labels, rough, window)
    # Reasons follow from changes up to REASON_PX off, these from probabilities up to MEANS_PX off,
    # and these from the agreement of the pixels beside. Labels farther off need no images.
    labels = labels.around(window.grown(REASON_PX + MEANS_PX + 1))
    equal = window.of_equal_noise(scene.noise)
    comparison = Comparison(scene.settings.window, EQUAL, scene.settings.diachronic)
    labels = without_changes(labels, window, equal, comparison)
    return with_reasons(labels, is_rough, own, equal, comparison, scene.scale.px_per_m)


def paper_recipe(scene: SceneInputs, window: PairWindow, points: WindowPoints) -> WindowLabels:
    """The labels of a window by each pixel's own points."""
    model, px_per_m = scene.pair.model, scene.rays.px_per_m
    return paper_labels(scene.settings, model, points.by_pixel, window, px_per_m, scene.days)
