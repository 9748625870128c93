"""Vertices: means of the tops of cells, one in place of many where the ground is even."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.lidar.lattice import LATTICE_M
from stereotruth.surface.scale import EVEN_REACH, PART, PART_BITS, SQUARE_CELLS
from stereotruth.surface.vertices import VertexBuilder, Vertices

from ...synthetic.strewn_points import scale_of

CELL = 3000
SCALE = scale_of(1.0, (CELL, CELL))
SIZE = 64  # cells


def built(height_at, low=(0, 0), kept=None, noise_m=0.0, kinds=2, order=None) -> Vertices:
    """Vertices of four points in each of SIZE x SIZE cells; x, y in cells, heights in m."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.0, SIZE, (2, 4 * SIZE * SIZE))
    h = height_at(x, y) + rng.normal(0.0, 1.0, x.size) * noise_m
    classes = np.broadcast_to(np.asarray(kinds(x, y) if callable(kinds) else kinds), x.shape)
    use = np.ones(x.size, np.bool_) if kept is None else kept(x, y)
    use = np.flatnonzero(use) if order is None else np.flatnonzero(use)[order]
    builder = VertexBuilder(SCALE, low, (SIZE * CELL, SIZE * CELL))
    lon, lat = ((c[use] * CELL).astype(np.int64) for c in (x, y))
    q = np.rint(h[use] / LATTICE_M).astype(np.int64)
    returns, days = np.ones(lon.size, np.uint8), np.zeros(lon.size, np.uint16)
    builder.add(lon, lat, q, classes[use].astype(np.uint8), returns, days)
    return builder.built()


@pytest.mark.parametrize("cell", [(1, 1), (7, 5), (3001, 2999), (6765, 5849)])
def test_places_are_those_of_whole_numbers(cell) -> None:
    """West of Greenwich and south of the equator, on the corners of cells and one step off."""
    rng = np.random.default_rng(1)
    low = np.array([-70_123_456_789, -33_987_654_321])
    size = 40 * np.array(cell)
    places = low[:, None] + rng.integers(0, size, (400, 2)).T
    corners = (low // cell + rng.integers(1, 40, (400, 2))) * cell
    lon, lat = np.ascontiguousarray(np.hstack([places, corners.T, corners.T - 1]))
    scale = scale_of(1.0, cell)
    builder = VertexBuilder(scale, tuple(low.tolist()), tuple((low + size).tolist()))
    h = rng.integers(-(10**6), 10**6, lon.size)
    returns, days = np.ones(lon.size, np.uint8), np.zeros(lon.size, np.uint16)
    builder.add(lon, lat, h, np.full(lon.size, 2, np.uint8), returns, days)
    found = builder.built()
    tolerance = int(scale.top_m / LATTICE_M)
    expected = {}
    for i, j in {(i, j) for i, j in zip(lon // cell[0], lat // cell[1])}:
        here = (lon // cell[0] == i) & (lat // cell[1] == j)
        here &= h >= h[here].max() - tolerance
        n, (east, north, up) = here.sum(), (lon - i * cell[0], lat - j * cell[1], h)
        east, north = int(east[here].sum()) // n, int(north[here].sum()) // n
        first = low // cell
        expected[j, i] = (
            i * cell[0] + east,
            j * cell[1] + north,
            int(up[here].sum()) // n,
            ((i - first[0]) << PART_BITS) + east * PART // cell[0],
            ((j - first[1]) << PART_BITS) + north * PART // cell[1],
            n,
        )
    got = zip(found.lon_q, found.lat_q, found.h_q, found.x, found.y, found.count)
    assert list(got) == [expected[key] for key in sorted(expected)]


def in_middle(found: Vertices) -> np.ndarray:
    """Which vertices stand for a whole square."""
    return (found.lon_q % (SQUARE_CELLS * CELL) == SQUARE_CELLS // 2 * CELL) & (
        found.lat_q % (SQUARE_CELLS * CELL) == SQUARE_CELLS // 2 * CELL
    )


def test_even_ground_has_one_vertex_in_each_square() -> None:
    noise = 0.03
    found = built(lambda x, y: 10.0 + 0.02 * x - 0.01 * y, noise_m=noise)
    squares = SIZE // SQUARE_CELLS - 2  # nobody knows what lies around those of the border
    middle = in_middle(found)
    assert middle.sum() == squares**2
    x, y = found.lon_q[middle] / CELL, found.lat_q[middle] / CELL
    off = found.h_q[middle] * LATTICE_M - (10.0 + 0.02 * x - 0.01 * y)
    # the mean of some 16 cells, each of which is the mean of its points within the tolerance
    assert np.abs(off).max() < 4.5 * noise / np.sqrt(55.0)
    assert off.std() == pytest.approx(noise / np.sqrt(55.0), rel=0.3)
    assert found.count[middle].mean() == pytest.approx(4 * SQUARE_CELLS**2, rel=0.05)
    inside = (found.x > 4 * PART) & (found.x < (SIZE - 4) * PART)
    inside &= (found.y > 4 * PART) & (found.y < (SIZE - 4) * PART)
    assert middle[inside].all()
    order = (found.y >> PART_BITS) * 10_000 + (found.x >> PART_BITS)
    assert (np.diff(order) > 0).all()


def test_all_vertices_stay_beside_a_step_and_where_classes_meet() -> None:
    for height_at, kinds in (
        (lambda x, y: np.where(x > 31.3, 0.5, 0.0), 2),
        (lambda x, y: 0.0 * x, lambda x, y: np.where(x > 31.3, 3, 2)),
    ):
        found = built(height_at, kinds=kinds)
        middle = in_middle(found)
        beside = np.abs(found.lon_q / CELL - 31.3) < SQUARE_CELLS
        assert beside.sum() > 7 * SIZE * 0.95 and not middle[beside].any()
        assert middle[~beside].sum() > 100


def test_ground_that_is_rougher_than_a_label_may_be_keeps_all_vertices() -> None:
    assert not in_middle(built(lambda x, y: 0.0 * x, noise_m=0.2)).any()


def test_a_window_has_the_vertices_of_the_whole_in_any_order() -> None:
    def height_at(x, y):
        return np.where((np.abs(x - 40.0) < 9.0) & (np.abs(y - 37.0) < 7.0), 6.0, 0.01 * x)

    whole = built(height_at, noise_m=0.02)
    edge = 11

    def kept(x, y):
        return (x > edge) & (y > edge)

    count = int(kept(*np.random.default_rng(0).uniform(0.0, SIZE, (2, 4 * SIZE * SIZE))).sum())
    order = np.random.default_rng(1).permutation(count)
    part = built(height_at, ((edge - 1) * CELL, (edge - 1) * CELL), kept, 0.02, order=order)

    def inside(found: Vertices) -> list[tuple[int, ...]]:
        near = np.minimum(found.lon_q, found.lat_q) >= (edge + EVEN_REACH) * CELL
        names = "lon_q", "lat_q", "h_q", "surface_class", "count"
        return list(zip(*(getattr(found, name)[near].tolist() for name in names)))

    assert len(inside(whole)) > 100 and inside(part) == inside(whole)


def test_vertices_are_means_of_the_tops_of_cells() -> None:
    scale = scale_of(1.0, (3000, 2500))
    lon = np.array([6010, 6030, 6020, 9001, 9005, 9001, 9001])
    lat = np.array([2600, 2700, 2650, 2510, 2515, 2510, 2510])
    # the third lies 4 m below; three are one point of two days, and of another class
    height = np.array([100_000, 100_200, 60_000, 50_000, 50_010, 50_000, 50_000])
    classes = np.array([6, 5, 2, 2, 5, 2, 1], np.uint8)
    returns = np.array([1, 0, 1, 1, 2, 1, 1], np.uint8)  # what is not told counts, 2 does not
    days = np.array([18_000, 17_000, 18_000, 17_000, 19_000, 18_500, 19_000], np.uint16)
    whole = VertexBuilder(scale, (0, 0), (20_000, 20_000))
    whole.add(lon, lat, height, classes, returns, days)
    found = whole.built()
    assert found.lon_q.tolist() == [6020, 9001]
    assert found.lat_q.tolist() == [2650, 2510]
    assert found.h_q.tolist() == [100_100, 50_000]
    assert found.count.tolist() == [2, 3]
    assert found.surface_class.tolist() == [5, 2]  # that of the highest
    assert found.day.tolist() == [17_000, 18_500]  # likewise; the later one of those of its class
    other = VertexBuilder(scale, (3000, 2500), (20_000, 20_000))
    for k in (5, 6, 3, 1, 4, 2, 0):
        other.add(*(v[k : k + 1] for v in (lon, lat, height, classes, returns, days)))
    again = other.built()
    for name in ("lon_q", "lat_q", "h_q", "surface_class", "count", "day"):
        assert getattr(again, name).tolist() == getattr(found, name).tolist()
    assert (found.x - again.x).tolist() == [PART, PART]
