"""Labels of rough surfaces, as crowns are, with an uncertainty of their own.

Between points that lie close together a rough surface is known to some tenths of a pixel. So

1. its points are tops, and those that went through it (:mod:`stereotruth.surface.surface`);
2. a pixel's value is linear in the triangle of tops that is nearest to the left camera;
3. a pixel is labelled if no other triangle, facet or steep, nor a strip between known surfaces may
   be nearer to either camera, if nothing near it is much higher, if nothing higher comes close to
   it in the right image (:func:`_clearance`), and if most pixels around it have labels;
4. the uncertainty follows from what is between the points: the residuals of tops to the planes of
   the triangles beside them, how much the triangle rises, and how much higher the pixels beside it
   are (eq. 12 of docs/explanation/surface.md).

No image decides which surface a pixel shows. All follows from the points around a pixel alone, in
an order that no window changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.windows import box_max, window_sums
from ..core.status import Status, is_labelled
from ..lidar.lattice import LATTICE_M
from ..lidar.point_store import WATER_CLASS
from ..surface.facet_values import Facets, PixelValues
from ..surface.raster import (
    FACET_IN_RIGHT,
    OCCLUSION_TOLERANCE_PX,
    PRISM_IN_LEFT,
    PRISM_IN_RIGHT,
    ProjectedSurface,
    SeenSurface,
    right_pixels,
)
from ..surface.scale import FACET_RESIDUAL_PX
from ..surface.surface import RoughTops
from .pair_window import Labels, PairWindow, WindowLabels, merged_status
from .view_geometry import PixelScale

Steps = NDArray[np.int32]

# A pixel has no label if one up to HIGHER_REACH px off is higher by HIGHER_PX: a contour that
# points determine to a pixel alone may cover it in either view.
HIGHER_PX, HIGHER_REACH = 4.0, 3
# Nor if a surface that is higher by ABOVE_PX comes nearer to it than CLEARANCE_PX in the right
# image. The next BESIDE_PX of a row can do so. Contours of crowns lie beyond their last points, by
# about a spacing of points. Six drawn scenes (bench/refinement.py).
CLEARANCE_PX, ABOVE_PX, BESIDE_PX = 2.0, 0.75, 12
# Nor if fewer of the 3 x 3 pixels around it have labels: what stands alone lies beside a contour.
# (Steep forest, 4 and 1 points/m²: 0.2 and 0.5 % fewer visible pixels, hidden ones 0.90 for 1.09 %
# and 1.32 for 1.88 %, and of the labels 0.19 for 0.22 % and 0.64 for 0.83 % off by more than 1 px.)
LABELS_AROUND = 5
CROWN_REACH_PX = BESIDE_PX + 2  # pixels around one that its label follows from
NEAR_BITS = 3  # squares of 8 px of the right image, in which crowns are or not
# Standard uncertainty, px, where points are a pixel apart: of its own, and per px of residual, of
# the triangle's rise, and of what is higher beside the pixel. It grows with the spacing of points
# to the power of GROWTH.
OWN, RESIDUAL, RISE, HIGHER = 0.057, 0.074, 0.155, 0.455
GROWTH = 0.66


@kernel
def _higher(disparity: Floats, reach: int, wanted: Bools) -> Floats:
    """By how much the highest disparity up to ``reach`` px around is above each ``wanted`` pixel's
    own, px (κ of eq. 12 of docs/explanation/surface.md); NaN elsewhere."""
    rows, cols = disparity.shape
    out = np.full(disparity.shape, np.nan)
    for j in range(rows):
        for i in range(cols):
            if not wanted[j, i]:
                continue
            high = -np.inf
            for b in range(max(j - reach, 0), min(j + reach + 1, rows)):
                for a in range(max(i - reach, 0), min(i + reach + 1, cols)):
                    if disparity[b, a] > high:  # false for NaN
                        high = disparity[b, a]
            out[j, i] = high - disparity[j, i]
    return out


@kernel
def _clearance(disparity: Floats, above: Floats, reach_rows: int, wanted: Bools) -> Floats:
    """Distance px in the right image from each ``wanted`` pixel to the nearest surface that is
    higher; infinite elsewhere.

    ``disparity`` [h, w] of the pixels, ``above`` [h, w] of what may be higher, NaN for nothing. The
    next BESIDE_PX to the right in the left image count, in ``reach_rows`` rows above and below the
    pixel's, too. Infinite without a higher surface, below 0 where one covers the pixel (eq. 14 of
    docs/explanation/surface.md).
    """
    rows, cols = disparity.shape
    out = np.full(disparity.shape, np.inf)
    for j in range(rows):
        for i in range(cols):
            if not wanted[j, i]:
                continue
            for b in range(max(j - reach_rows, 0), min(j + reach_rows + 1, rows)):
                for a in range(i + 1, min(i + BESIDE_PX + 1, cols)):
                    rise = above[b, a] - disparity[j, i]
                    if rise > ABOVE_PX and a - i - rise < out[j, i]:  # false for NaN
                        out[j, i] = a - i - rise
    return out


@dataclass(frozen=True, eq=False)
class Crowns:
    """What rough surfaces show at the centres of pixels; arrays [h, w].

    ``visible``: from both cameras. Of these ``labels``: disparity px, slope, variance px² (of the
    points and of what is between them); ``height`` m, ``surface_class`` (ASPRS) and ``day`` of the
    nearest point. ``tops`` px: disparity of the nearest triangle of tops, steep ones too.
    """

    visible: Bools
    labels: Labels
    height: Floats
    surface_class: NDArray[np.uint8]
    day: NDArray[np.uint16]
    tops: Floats


@dataclass(frozen=True, eq=False)
class NearestTops:
    """What the tops of rough surfaces show in an image, arrays [h, w] px of disparity.

    ``index`` of the nearest gentle triangle of tops, -1 for none, and its ``disparity``, NaN;
    ``before``: greatest of what else is known there, facets, steep triangles, strips; −∞;
    ``highest``: greatest of both, NaN for nothing; ``tops``: that of all triangles of tops, −∞.
    """

    index: NDArray[np.int32]
    disparity: Floats
    before: Floats
    highest: Floats
    tops: Floats

    @classmethod
    def of(cls, seen: SeenSurface) -> NearestTops:
        """In the image in which a surface is ``seen``."""
        shape, projected, rough = seen.disparity.shape, seen.projected, seen.projected.surface.tops
        gentle, index = projected.raster(rough.corner[rough.is_gentle], shape)
        steep, _ = projected.raster(rough.corner[~rough.is_gentle], shape)
        disparity = np.where(index >= 0, gentle, np.nan)
        before = np.fmax(np.maximum(steep, seen.strips), seen.disparity)
        highest = np.fmax(disparity, np.where(np.isneginf(before), np.nan, before))
        return cls(index, disparity, before, highest, np.maximum(gentle, steep))

    def in_front(self) -> Bools:
        """Where a gentle triangle is nearest, and nothing near it is much higher."""
        with np.errstate(invalid="ignore"):
            out = self.disparity > self.before - OCCLUSION_TOLERANCE_PX
            return out & (_higher(self.highest, HIGHER_REACH, out) <= HIGHER_PX)

    def values(self, chosen: Bools, projected: ProjectedSurface) -> PixelValues:
        """What the triangles of the ``chosen`` pixels have there; the variance is none of
        theirs."""
        rough = projected.surface.tops
        corner = rough.corner[rough.is_gentle]
        none = np.zeros(len(corner), np.float32)
        index = np.where(chosen, self.index, np.int32(-1))
        return projected.values(Facets(corner, none, none), index)

    def variance(self, chosen: Bools, rough: RoughTops, scale: PixelScale) -> Floats:
        """Variance px² [h, w] of what the ``chosen`` pixels show, NaN elsewhere."""
        out = np.full(chosen.shape, np.nan)
        higher = _higher(self.highest, 1, chosen)[chosen]
        out[chosen] = _variance(rough, self.index[chosen], higher, scale)
        return out


def crowns(seen: SeenSurface, scale: PixelScale, edge_margin_px: float) -> Crowns:
    """The rough surfaces of a window, at pixels of which the facets leave open what they show;
    none whose centre lies nearer than ``edge_margin_px`` to another surface."""
    nearest = NearestTops.of(seen)
    disparity = nearest.disparity
    is_open = np.isin(seen.visibility, (PRISM_IN_LEFT, PRISM_IN_RIGHT))
    # what facets show has labels already, as far as it is certain
    with np.errstate(invalid="ignore"):
        labelled = is_open & nearest.in_front()
        labelled &= ~(np.abs(disparity - seen.disparity) <= FACET_RESIDUAL_PX)
    spacing_rows = int(np.ceil(scale.spacing_px))
    labelled &= _clearance(disparity, nearest.highest, spacing_rows, labelled) >= CLEARANCE_PX
    labelled &= ~_hidden_in_right(seen.projected, labelled, disparity)
    values = nearest.values(labelled, seen.projected)
    variance = nearest.variance(labelled, seen.projected.surface.tops, scale)
    labelled &= values.surface_class != WATER_CLASS
    if edge_margin_px > 0.0:
        surface = seen.projected.surface
        corner = np.concatenate([surface.facet, surface.tops.corner])
        known = np.where(labelled, disparity, np.nan), values.slope
        labelled &= ~seen.projected.near_edge(*known, edge_margin_px, corner, surface.strips)
    labels = Labels(disparity, values.slope, variance)
    of_pixels = values.height * LATTICE_M, values.surface_class, values.day
    return Crowns(labelled, labels, *of_pixels, nearest.tops)


def without_contours(
    labels: WindowLabels, crowns: Crowns, seen: SeenSurface, scale: PixelScale
) -> WindowLabels:
    """Labels of facets, without those that the contour of a crown may hide from the right camera.

    A contour lies beyond the crown's last points, by about a spacing. So a pixel beside one that is
    hidden, or may be, is uncertain itself where a crown comes nearer than the diagonal of a
    spacing in the right image.
    """
    hidden = np.isin(seen.visibility, (PRISM_IN_RIGHT, FACET_IN_RIGHT))
    beside = np.zeros_like(hidden)
    beside[:, :-1] = hidden[:, 1:]
    reach = int(scale.spacing_px)
    if reach:
        beside |= box_max(hidden, reach)
    beside &= is_labelled(labels.status)
    clearance = _clearance(labels.labels.disparity, crowns.tops, 1, beside)
    uncertain = beside & (clearance < np.sqrt(2) * scale.spacing_px)
    return replace(labels, status=merged_status({Status.EDGE_IN_PIXEL: uncertain}, labels.status))


@kernel
def _near(
    x: Floats, y: Floats, corner: Steps, first: tuple[int, int], squares: Bools, out: Bools
) -> None:
    """Which triangles' bounding boxes in the right image touch one of the ``squares``, of which
    ``first`` is the (row, column) px of the first."""
    rows, cols = squares.shape
    for t in range(len(corner)):
        a, b, c = corner[t]
        top = (int(np.floor(min(y[a], y[b], y[c]))) - first[0]) >> NEAR_BITS
        bottom = (int(np.floor(max(y[a], y[b], y[c]))) - first[0]) >> NEAR_BITS
        if top >= rows or bottom < 0:
            continue
        left = (int(np.floor(min(x[a], x[b], x[c]))) - first[1]) >> NEAR_BITS
        right = (int(np.floor(max(x[a], x[b], x[c]))) - first[1]) >> NEAR_BITS
        for j in range(max(top, 0), min(bottom + 1, rows)):
            for i in range(max(left, 0), min(right + 1, cols)):
                out[t] |= squares[j, i]


def _hidden_in_right(projected: ProjectedSurface, labelled: Bools, disparity: Floats) -> Bools:
    """Which pixels ``labelled`` [h, w] a facet, a triangle of the tops, or a strip between known
    surfaces hides from the right camera."""
    out = np.zeros(labelled.shape, np.bool_)
    row, col = np.nonzero(labelled)
    if row.size:
        surface = projected.surface
        pixels = right_pixels(row, col, disparity[row, col], projected.first)
        # crowns are few: most facets are near none of them
        column = np.floor(col + projected.first[1] - disparity[row, col]).astype(np.int64)
        size = int(row.max()) >> NEAR_BITS, (pixels.width - 1) >> NEAR_BITS
        squares = np.zeros((size[0] + 1, size[1] + 1), np.bool_)
        squares[row >> NEAR_BITS, column - pixels.first[1] >> NEAR_BITS] = True
        near = np.zeros(len(surface.facet), np.bool_)
        _near(*projected.xy[2:], surface.facet, pixels.first, squares, near)
        corner = np.concatenate([surface.facet[near], surface.tops.corner])
        hidden = projected.hidden_by_facets(corner, pixels)
        out[row, col] = hidden | projected.hidden_by_prisms(surface.strips, pixels)
    return out


def _variance(
    rough: RoughTops, index: NDArray[np.int32], higher: Floats, scale: PixelScale
) -> Floats:
    """Variance px² [n] of what the triangle ``index`` of tops shows, of pixels beside which others
    are ``higher`` by so much, px (eq. 12 of docs/explanation/surface.md)."""
    step_px = scale.px_per_m * LATTICE_M
    parts = (
        np.full(index.shape, OWN),
        RESIDUAL * (rough.residual * step_px)[rough.is_gentle][index],
        RISE * (rough.rise * step_px)[rough.is_gentle][index],
        HIGHER * higher,
    )
    return sum(part**2 for part in parts) * scale.spacing_px ** (2.0 * GROWTH)


def with_crowns(labels: WindowLabels, crowns: Crowns, window: PairWindow) -> WindowLabels:
    """Labels with those of rough surfaces where these are seen and an edge in the pixel left none.

    Labels of other statuses stay as they are.
    """
    new = crowns.visible & (labels.status == Status.EDGE_IN_PIXEL)
    new, _ = window.usable(new, crowns.labels.disparity)
    around = window_sums(np.pad(new | is_labelled(labels.status), 1), 3)
    new &= around >= LABELS_AROUND
    of_crowns, others = crowns.labels, labels.labels
    return replace(
        labels,
        status=merged_status({Status.LABELLED_CROWN: new}, labels.status),
        labels=Labels(
            np.where(new, of_crowns.disparity, others.disparity),
            np.where(new, of_crowns.slope, others.slope),
            np.where(new, of_crowns.variance, others.variance),
        ),
        height=np.where(new, crowns.height, labels.height),
        surface_class=np.where(new, crowns.surface_class, labels.surface_class),
        day=np.where(new, crowns.day, labels.day),
    )
