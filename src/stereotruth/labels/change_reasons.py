"""What has changed where images and LiDAR show different surfaces: the layer ``change``.

Each pixel of status ``changed`` gets a reason (:class:`.status.Reason`). What stood there at the
LiDAR's date its class says; what stands there in the images the shift says at which these agree
better, and the size of the patch that has changed:

1. *Evidence* (:func:`evidence_of`): the LiDAR's class, the rise of the surface from the LiDAR to
   the images, how large the patch is, and what the LiDAR has beside it.
2. *Reasons of pixels* (:func:`pixel_reasons`), by the first rule that holds; none where nothing
   tells.
3. *Votes* (:func:`by_votes`): the reason of most changed pixels around, of one surface class;
   ``unknown`` where none of them has any.

All follows from the pixels up to REASON_PX around a pixel and is counted in whole numbers, so that
no block changes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.arrays import Bools, Bytes, Floats
from ..core.numerics.windows import box_max, window_sums
from ..core.status import Reason
from ..lidar.point_store import VEGETATION_CLASSES, WATER_CLASS
from .change_evidence import WINDOW_PX, LabelledWindow
from .shifted_agreement import WIDE_SHIFTS_PX, shifted_agreement

UNCLASSED = (0, 1)  # ASPRS: never classified, and unclassified
GROUND_CLASS, TREE_CLASS, BUILDING_CLASS = 2, 5, 6
AROUND_PX = 16  # up to here the patch is measured, and ground and water beside it are looked for
VOTES_PX, STRONG = 16, 4  # pixels up to here vote; with positive evidence one counts so many
QUORUM = 0.03  # share of the pixels that must have a reason
# A rise that so many of the pixels around share is no chance agreement, which takes any of
# WIDE_SHIFTS_PX: three of 26 in a row have a ninth.
COMMON = 0.35
REASON_PX = AROUND_PX + VOTES_PX  # by which these reach beyond the statuses that they follow from
CROWN_PX, CROWN_PIXELS = 6, 5  # a tree has grown: up to here the LiDAR has so many pixels of one
CROP_M = 3.2  # no crop is higher, and no storey lower
VEHICLE_M = 3.3  # no vehicle is higher
SHORE_M = 4.0  # above the water, what a flood reaches
# Of the pixels up to AROUND_PX around, the share that a crown and a vehicle take at most.
CROWN_SHARE, VEHICLE_SHARE = 0.25, 0.16
TOGETHER_PX = 4  # pixels up to here are averaged, for the shift at which the images agree
LEAST = 0.3  # agreement that chance has at one of the shifts


class Evidence(NamedTuple):
    """What tells why pixels have changed; arrays [h, w].

    ``changed``; ``surface_class`` (ASPRS) of what the LiDAR shows; ``rise`` (m) of the surface from
    the LiDAR to the images, NaN where these agree nowhere better. Whether the LiDAR's surface
    ``is_low`` enough over the ground around for a vehicle; whether the patch ``is_small`` enough
    for one; whether it ``is_crown``, small enough and with vegetation of the LiDAR in it; whether
    it ``is_shore``, beside water of the LiDAR and not much higher. ``is_sure``: the rise is that of
    most pixels around, and no chance agreement. ``is_unlike``: the images have two lights, so that
    what is new agrees at no height, and what was there has gone if it does not either.
    """

    changed: Bools
    surface_class: Bytes
    rise: Floats
    is_low: Bools
    is_small: Bools
    is_crown: Bools
    is_shore: Bools
    is_sure: Bools
    is_unlike: bool


@dataclass(frozen=True, eq=False)
class ChangedSurface:
    """What the LiDAR shows at the pixels of a window, arrays [h, w].

    ``changed``; ``height`` (m) and ``surface_class`` (ASPRS) of the surface; ``is_rough``: whether
    it is a rough surface. Of the points in each pixel ``highest`` (m, NaN for none) and its class.
    """

    changed: Bools
    height: Floats
    surface_class: Bytes
    is_rough: Bools
    highest: NDArray[np.floating]
    highest_class: Bytes

    @cached_property
    def classes(self) -> Bytes:
        """The surface's class [h, w]; without one, by its roughness and height over the lowest
        point around."""
        lowest = -box_max(np.fmax(-self.highest, -np.inf), AROUND_PX)
        is_high = self.height - lowest > VEHICLE_M
        by_height = np.where(is_high, BUILDING_CLASS, GROUND_CLASS)
        by_height = np.where(self.is_rough, TREE_CLASS, by_height)
        unclassed = np.isin(self.surface_class, UNCLASSED)
        return np.where(unclassed, by_height, self.surface_class).astype(np.uint8)


def box_count(chosen: Bools, reach: int) -> NDArray[np.int64]:
    """Number of ``chosen`` pixels [h, w] up to ``reach`` px around each."""
    return window_sums(np.pad(chosen, reach), 2 * reach + 1)


def evidence_of(
    surface: ChangedSurface, shift: Floats, px_per_m: float, diachronic: bool
) -> Evidence:
    """From the ``surface`` of the LiDAR, the ``shift`` (px) [h, w] at which the images agree better
    (NaN for none), and the disparity of a metre of height; ``diachronic``: of two lights."""
    changed, highest, classes = surface.changed, surface.highest, surface.highest_class
    ground = -box_max(np.where(classes == GROUND_CLASS, -highest, -np.inf), AROUND_PX)
    water = box_max(np.where(classes == WATER_CLASS, highest, -np.inf), AROUND_PX)
    vegetation = box_count(np.isin(classes, VEGETATION_CLASSES), CROWN_PX) >= CROWN_PIXELS
    is_building = changed & (surface.classes == BUILDING_CLASS)
    share = box_count(changed, AROUND_PX) / (2 * AROUND_PX + 1) ** 2
    return Evidence(
        changed=changed,
        surface_class=surface.classes,
        rise=np.where(changed, shift / px_per_m, np.nan),
        is_low=surface.height - ground <= VEHICLE_M,
        is_small=share <= VEHICLE_SHARE,
        is_crown=vegetation & (share <= CROWN_SHARE),
        is_shore=surface.height < water + SHORE_M,
        is_sure=is_common(shift, is_building, VOTES_PX) if diachronic else np.isfinite(shift),
        is_unlike=diachronic,
    )


def is_common(shift: Floats, chosen: Bools, reach: int) -> Bools:
    """Where the ``shift`` (px, of WIDE_SHIFTS_PX; NaN for none) [h, w] of ``chosen`` pixels is that
    of the share COMMON of those up to ``reach`` px around that have any, or one beside theirs."""
    out = np.zeros(shift.shape, np.bool_)
    has_any = chosen & np.isfinite(shift)
    every = box_count(has_any, reach)
    steps = np.sort(np.array(WIDE_SHIFTS_PX))
    for k, step in enumerate(steps):
        at_step = has_any & (shift == step)
        if at_step.any():
            near = has_any & np.isin(shift, steps[max(k - 1, 0) : k + 2])
            out |= at_step & (box_count(near, reach) >= COMMON * every)
    return out


def pixel_reasons(evidence: Evidence) -> tuple[Bytes, Bools]:
    """Reasons of pixels [h, w] by themselves, NONE where nothing tells; and whether more than the
    absence of any agreement tells it."""
    e = evidence
    building = e.surface_class == BUILDING_CLASS
    vegetation = np.isin(e.surface_class, VEGETATION_CLASSES)
    ground = ~(building | vegetation)
    is_level, is_open = np.abs(e.rise) <= CROP_M, np.isnan(e.rise)
    rules = (
        ((e.surface_class == WATER_CLASS) | (ground & e.is_shore), Reason.WATER),
        (vegetation, Reason.GROWN_OR_FELLED),
        (building & e.is_low & e.is_small, Reason.MOVED),
        (building & e.is_sure & (e.rise > 0), Reason.BUILT),
        (building & (e.is_sure & (e.rise < 0) | e.is_unlike), Reason.DEMOLISHED),
        (building, Reason.NONE),
        (e.is_crown & ~(e.rise < 0), Reason.GROWN_OR_FELLED),
        (e.is_small & (is_open | is_level), Reason.MOVED),
        (is_level, Reason.GROUND),
        # higher than a crop; or so large that it is no vehicle, and where neither image agrees
        (~(e.rise < 0), Reason.BUILT),
    )
    chosen = np.select([rule for rule, _ in rules], [reason for _, reason in rules], Reason.NONE)
    chosen = np.where(e.changed, chosen, Reason.NONE).astype(np.uint8)
    is_strong = np.where(building, e.is_sure & ~is_open, ~is_open)
    return chosen, vegetation | is_strong | (chosen == Reason.WATER)


def by_votes(reasons: Bytes, is_strong: Bools, evidence: Evidence) -> Bytes:
    """For each changed pixel [h, w] the reason of most of those up to VOTES_PX around it that are
    of its surface class; UNKNOWN where fewer than the share QUORUM of these have any. Strong ones
    count STRONG votes."""
    out = np.where(evidence.changed, Reason.UNKNOWN, Reason.NONE).astype(np.uint8)
    for surface_class in np.unique(evidence.surface_class[evidence.changed]):
        here = evidence.changed & (evidence.surface_class == surface_class)
        most = np.zeros(here.shape, np.int64)
        has_any = box_count(here & (reasons != Reason.NONE), VOTES_PX)
        quorum = here & (has_any > QUORUM * box_count(here, VOTES_PX))
        for reason in np.unique(reasons[here & (reasons != Reason.NONE)]):
            votes = box_count(here & (reasons == reason), VOTES_PX)
            votes += (STRONG - 1) * box_count(here & is_strong & (reasons == reason), VOTES_PX)
            more = quorum & (votes > most)
            out[more], most[more] = reason, votes[more]
    return out


def reasons_of(
    surface: ChangedSurface, compared: LabelledWindow, px_per_m: float, diachronic: bool
) -> Bytes:
    """Why the pixels [h, w] of a window have changed (:class:`.status.Reason`).

    ``px_per_m``: disparity of a metre of height; ``diachronic``: whether the images share no light.
    """
    changed, window = surface.changed, compared.window
    if not changed.any():
        return np.zeros(changed.shape, np.uint8)
    by_class = np.isin(surface.classes, (*VEGETATION_CLASSES, WATER_CLASS))
    votes = window.grown(REASON_PX)  # what votes has the votes' reach of its own
    asked = np.zeros_like(changed)
    asked[votes] = changed[votes] & ~by_class[votes]
    shifted = shifted_agreement(
        compared.labels, window, compared.noise, WINDOW_PX, TOGETHER_PX, asked, WIDE_SHIFTS_PX
    )
    agrees = shifted.is_shifted & (shifted.elsewhere > LEAST)
    shift = np.where(agrees, shifted.shift, np.float32(np.nan)).astype(np.float64)
    evidence = evidence_of(surface, shift, px_per_m, diachronic)
    return by_votes(*pixel_reasons(evidence), evidence)
