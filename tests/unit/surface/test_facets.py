"""Which triangles of points are facets, on slopes, ridges and height steps."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.lidar.lattice import LATTICE_M

from ...synthetic.strewn_points import NOISE_M, parts, scale_of, surface_of


def inner(part) -> np.ndarray:
    """Triangles well inside of the points."""
    x, y = part.x.mean(axis=1), part.y.mean(axis=1)
    return (np.abs(x - 25.0) < 15.0) & (np.abs(y - 25.0) < 15.0)


def facet_share(surface) -> float:
    """Area of the facets of all triangles, well inside."""
    each = (parts(surface, corner) for corner in (surface.facet, surface.undecided))
    area = [part.area[inner(part)].sum() for part in each]
    return area[0] / sum(area)


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_slopes_are_facets_whose_noise_is_estimated(slope) -> None:
    surface = surface_of(lambda x, y: slope * x)
    assert facet_share(surface) > 0.99
    assert (surface.bulge[inner(parts(surface, surface.facet))] == 0.0).mean() > 0.97
    noise = surface.variance[inner(parts(surface, surface.facet))]
    assert np.sqrt(np.median(noise)) * LATTICE_M == pytest.approx(NOISE_M, rel=0.35)


def test_a_gabled_roof_has_facets_across_its_ridge() -> None:
    assert facet_share(surface_of(lambda x, y: -0.6 * np.abs(x - 25.0))) > 0.9


def test_crowns_have_facets_but_for_their_rims() -> None:
    """Half ellipsoids of 3.5 m on flat ground, at random points 1 m apart; 1 px of disparity per m.

    Of the triangles well within a crown, steep ones included, most are facets, and off it by less
    than a pixel; none joins a crown with the ground beside it.
    """
    centres = [(x, y) for x in (13.0, 21.0, 29.0, 37.0) for y in (13.0, 21.0, 29.0, 37.0)]

    def forest(x, y):
        far = np.min([np.hypot(x - a, y - b) for a, b in centres], axis=0)
        return np.where(far < 3.5, 6.0 + 4.0 * np.sqrt(np.maximum(1 - (far / 3.5) ** 2, 0)), 0.0)

    surface = surface_of(forest)
    facets, undecided = (parts(surface, corner) for corner in (surface.facet, surface.undecided))

    def in_crowns(part) -> np.ndarray:
        far = np.min([np.hypot(part.x - a, part.y - b) for a, b in centres], axis=0)
        return (far < 2.8).all(axis=1)

    area = [part.area[in_crowns(part)].sum() for part in (facets, undecided)]
    assert area[0] / sum(area) > 0.95
    top = in_crowns(facets)
    off = facets.h.mean(axis=1) - forest(facets.x.mean(axis=1), facets.y.mean(axis=1))
    assert np.abs(off[top]).max() < 1.0
    # at its centre a triangle bulges by a third of the form's factor
    bulging = off[top] + surface.bulge[top] * LATTICE_M / 3.0
    assert off[top].mean() < -0.08 and np.abs(bulging.mean()) < 0.03
    assert np.abs(bulging).mean() < 0.6 * np.abs(off[top]).mean()
    assert np.ptp(facets.h, axis=1).max() < 3.5


@pytest.mark.parametrize("height", [1.0, 2.0, 30.0])
@pytest.mark.parametrize("width", [1.2, 8.0])
def test_a_height_step_has_no_facet(height, width) -> None:
    """A block of one row of points, or of many: no facet joins its top and its foot."""

    def block(x, y):
        return np.where(np.abs(x - 25.0) < width / 2, height, 0.0)

    surface = surface_of(block)
    facets = parts(surface, surface.facet)
    assert np.ptp(facets.h, axis=1).max() < 0.5
    far = (np.abs(np.abs(facets.x - 25.0) - width / 2) > 1.0).all(axis=1)
    assert np.abs(facets.h - block(facets.x, facets.y))[far].max() < 0.5
    assert facet_share(surface) > 0.8


def test_radii_follow_the_spacing_of_points() -> None:
    dense, sparse = (scale_of(n) for n in (8.2, 8.2e-3))
    assert sparse.facet_radius == pytest.approx(dense.facet_radius * 1000**0.5, rel=0.1)
