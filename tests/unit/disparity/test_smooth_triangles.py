"""Which triangles of points are smooth, on slopes, ridges and steps."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.smooth_triangles import STEP_PX, Scale
from stereotruth.lidar.lattice import LATTICE_M

from ...synthetic.strewn_points import NOISE_M, parts, surface_of


def inner(part) -> np.ndarray:
    """Triangles well inside of the points."""
    x, y = part.x.mean(axis=1), part.y.mean(axis=1)
    return (np.abs(x - 25.0) < 15.0) & (np.abs(y - 25.0) < 15.0)


def smooth_share(found) -> float:
    """Area of the smooth triangles of all, well inside."""
    smooth, steps = (parts(found, corner) for corner in (found.smooth, found.steps))
    area = [part.area[inner(part)].sum() for part in (smooth, steps)]
    return area[0] / sum(area)


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_slopes_are_smooth_and_noise_is_told(slope) -> None:
    found = surface_of(lambda x, y: slope * x)
    assert smooth_share(found) > 0.99
    assert (found.bulge[inner(parts(found, found.smooth))] == 0.0).mean() > 0.97
    noise = found.noise[inner(parts(found, found.smooth))]
    assert np.sqrt(np.median(noise)) * LATTICE_M == pytest.approx(NOISE_M, rel=0.35)


def test_a_gabled_roof_is_smooth_across_its_ridge() -> None:
    assert smooth_share(surface_of(lambda x, y: -0.6 * np.abs(x - 25.0))) > 0.9


def test_crowns_are_smooth_but_for_their_rims() -> None:
    """Half ellipsoids of 3.5 m on flat ground, at random points 1 m apart; 1 px of disparity per m.

    Of the triangles well within a crown, steep ones included, most are smooth, and off it by less
    than a pixel; none joins a crown with the ground beside it.
    """
    centres = [(x, y) for x in (13.0, 21.0, 29.0, 37.0) for y in (13.0, 21.0, 29.0, 37.0)]

    def forest(x, y):
        far = np.min([np.hypot(x - a, y - b) for a, b in centres], axis=0)
        return np.where(far < 3.5, 6.0 + 4.0 * np.sqrt(np.maximum(1 - (far / 3.5) ** 2, 0)), 0.0)

    found = surface_of(forest)
    smooth, steps = (parts(found, corner) for corner in (found.smooth, found.steps))

    def in_crowns(part) -> np.ndarray:
        far = np.min([np.hypot(part.x - a, part.y - b) for a, b in centres], axis=0)
        return (far < 2.8).all(axis=1)

    area = [part.area[in_crowns(part)].sum() for part in (smooth, steps)]
    assert area[0] / sum(area) > 0.95
    top = in_crowns(smooth)
    off = smooth.h.mean(axis=1) - forest(smooth.x.mean(axis=1), smooth.y.mean(axis=1))
    assert np.abs(off[top]).max() < 1.0
    # at its centre a triangle bulges by a third of the form's factor
    bulging = off[top] + found.bulge[top] * LATTICE_M / 3.0
    assert off[top].mean() < -0.08 and np.abs(bulging.mean()) < 0.03
    assert np.abs(bulging).mean() < 0.6 * np.abs(off[top]).mean()
    assert np.ptp(smooth.h, axis=1).max() < 3.5


@pytest.mark.parametrize("height", [1.0, 2.0, 30.0])
@pytest.mark.parametrize("width", [1.2, 8.0])
def test_a_step_is_smooth_nowhere(height, width) -> None:
    """A block of one row of points, or of many: no smooth triangle joins its top and its foot."""

    def block(x, y):
        return np.where(np.abs(x - 25.0) < width / 2, height, 0.0)

    found = surface_of(block)
    smooth = parts(found, found.smooth)
    assert np.ptp(smooth.h, axis=1).max() < 0.5
    far = (np.abs(np.abs(smooth.x - 25.0) - width / 2) > 1.0).all(axis=1)
    assert np.abs(smooth.h - block(smooth.x, smooth.y))[far].max() < 0.5
    assert smooth_share(found) > 0.8


def test_thresholds_follow_the_distance_of_points() -> None:
    dense, sparse = (Scale.of(n, 1.0) for n in (8.2, 8.2e-3))
    assert sparse.smooth == pytest.approx(dense.smooth * 11, rel=0.1)
    assert dense.trust == 1.0 and sparse.trust < 0.5
    assert STEP_PX <= 0.5  # a label of the wrong surface stays below a pixel
