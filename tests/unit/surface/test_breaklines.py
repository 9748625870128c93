"""Breaklines between points: where straight edges, corners and round edges are said to lie."""

from __future__ import annotations

import numpy as np
import pytest

from ...synthetic.strewn_points import parts, surface_of

TURN = np.radians(25.0)  # against the rows of points


def turned(x, y):
    """Places in a frame along the edges, about the middle of the points."""
    x, y = x - 25.0, y - 25.0
    return x * np.cos(TURN) + y * np.sin(TURN), y * np.cos(TURN) - x * np.sin(TURN)


def half(x, y):
    """A step of 8 m along a straight edge."""
    return np.where(turned(x, y)[0] > 0.0, 8.0, 0.0)


def house(x, y):
    """A box of 12 by 16 m."""
    u, v = turned(x, y)
    return np.where((np.abs(u) < 6.0) & (np.abs(v) < 8.0), 8.0, 0.0)


def tower(x, y):
    """A round one."""
    return np.where(np.hypot(x - 25.0, y - 25.0) < 7.0, 8.0, 0.0)


def areas(surface, height_at) -> tuple[float, float, float]:
    """m² within 12 m of the middle: on the right surface, on the wrong one, left open.

    By triangles of a grid of places, since a triangle may be large.
    """
    right = wrong = 0.0
    facets, undecided = parts(surface, surface.facet), parts(surface, surface.undecided)
    weights = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), 200)
    for part, is_facet in ((facets, True), (undecided, False)):
        x, y, h = (values @ weights.T for values in (part.x, part.y, part.h))
        near = (np.abs(x - 25.0) < 12.0) & (np.abs(y - 25.0) < 12.0)
        each = np.broadcast_to(part.area[:, None] / 200, near.shape)
        if is_facet:
            good = np.abs(h - height_at(x, y)) < 0.5
            right, wrong = each[near & good].sum(), each[near & ~good].sum()
        else:
            step = each[near].sum()
    return right, wrong, step


@pytest.mark.parametrize("spacing", [0.5, 1.0, 2.0])
def test_a_straight_edge_is_known_within_a_part_of_the_spacing(spacing) -> None:
    right, wrong, step = areas(surface_of(half, spacing), half)
    length = 24.0 / np.cos(TURN)
    assert right + wrong + step == pytest.approx(24.0**2, rel=0.01)  # the parts make up the whole
    assert step / length < 0.6 * spacing  # about one spacing without breaklines
    assert wrong < 0.002 * length


@pytest.mark.parametrize("height_at", [house, tower])
def test_corners_and_round_edges_stay_open_rather_than_wrong(height_at) -> None:
    _, wrong, step = areas(surface_of(height_at), height_at)
    around, off = {house: (56.0, 0.02), tower: (44.0, 0.15)}[height_at]
    assert step < 1.2 * around
    # m of the edge on the average; a round one is taken for straight over a few points
    assert wrong < off * around


def test_points_beyond_the_reach_do_not_move_a_cut() -> None:
    """Triangles in the middle of a part of the points are those of all points, to the bit."""
    whole, part = surface_of(house, side=80.0), surface_of(house, side=80.0, within=(0, 0, 55, 55))
    sorted_corners = []
    for surface in (whole, part):
        one = parts(surface, surface.facet)
        near = (np.hypot(one.x - 25.0, one.y - 25.0) < 9.0).all(axis=1)
        corners = np.concatenate([one.x, one.y, one.h], axis=1)[near]
        sorted_corners.append(corners[np.lexsort(corners.T)])
    assert len(sorted_corners[0]) > 200
    assert sorted_corners[0].tobytes() == sorted_corners[1].tobytes()
