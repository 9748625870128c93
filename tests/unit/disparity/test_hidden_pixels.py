"""Rays and surfaces on cameras whose directions are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.hidden_pixels import Rays, Surface, SurfaceBuilder, hidden_pixels
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.one_surface import SURFACE_PX
from stereotruth.lidar.lattice import LATTICE_DEG
from stereotruth.lidar.point_store import Points

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES, camera

SIZE = (320, 280)


def model_of(left=BACKWARD, right=FORWARD, angle: float = 90.0):
    sensors = [camera(tilt, angle=angle, size=SIZE) for tilt in (left, right)]
    return fit_epipolar(*sensors, SIZE, SIZE, HEIGHT, height_range=(HEIGHT - 50, HEIGHT + 100))


def points_at(east: np.ndarray, north: np.ndarray, height: np.ndarray) -> Points:
    """Points at metres from the scene's middle."""
    n = np.size(east)
    lattice = (
        np.round((LON + east / METRES[0]) / LATTICE_DEG),
        np.round((LAT + north / METRES[1]) / LATTICE_DEG),
        np.round(np.asarray(height) * 1e4),
    )
    flags = np.ones(n, np.uint8)
    return Points(*(values.astype(np.int64) for values in lattice), flags, flags, flags)


def plane_with_box(half: float, roof: float, spacing: float = 0.4) -> Points:
    rng = np.random.default_rng(0)
    east, north = np.mgrid[-70:70:spacing, -70:70:spacing].reshape(2, -1)
    east, north = np.stack([east, north]) + rng.uniform(-0.2, 0.2, (2, east.size)) * spacing
    inside = (abs(east) < half) & (abs(north) < half)
    return points_at(east, north, np.where(inside, HEIGHT + roof, HEIGHT))


def build_surface(points: Points, rays: Rays) -> Surface:
    """The surface of all given points."""
    low, high = ((int(edge(points.lon_q)), int(edge(points.lat_q))) for edge in (np.min, np.max))
    builder = SurfaceBuilder(rays, low, high)
    builder.add(points.lon_q, points.lat_q, points.h_q)
    return builder.built()


def verdicts(model, points: Points, east: np.ndarray, north: np.ndarray, height) -> np.ndarray:
    """What hidden_pixels says about single points, each as a pixel of its own."""
    rays = Rays.of(model)
    probes = points_at(east, north, np.broadcast_to(height, np.shape(east)).astype(float))
    middle = model.shape[0] // 2
    n = len(probes)
    sums = np.stack([np.ones(n, np.int64), probes.lon_q, probes.lat_q, probes.h_q], axis=1)
    # The cameras are affine: rays have one direction wherever the pixel is.
    return hidden_pixels(
        build_surface(points, rays), rays, sums, slice(middle, middle + 1), slice(0, n)
    )


@pytest.mark.parametrize(
    "tilts", [(BACKWARD, FORWARD), ((0.1, 0.3), (-0.2, -0.3)), ((0.0, 0.5), (0.0, 0.1))]
)
def test_ray_directions_and_scale(tilts) -> None:
    """A ray to a camera runs against the way the camera's image moves with height: 1e-5 m per m."""
    model = model_of(*tilts)
    rays = Rays.of(model)
    for view, tilt in enumerate(tilts):
        metres = rays.track[view, :, 0] * METRES
        assert metres == pytest.approx([-tilt[0], -tilt[1]], abs=1e-5)
        assert np.abs(rays.track[view, :, 1:]).max() * 300 * METRES.max() < 1e-5
    size = np.array(rays.cell) * LATTICE_DEG * METRES
    assert size == pytest.approx([0.325, 0.325], rel=0.02)
    base = np.hypot(*np.subtract(*tilts)) / 0.65
    assert rays.px_per_m == pytest.approx(base, rel=1e-3)


@pytest.mark.parametrize("tilts", [(BACKWARD, FORWARD), ((0.4, 0.3), (-0.4, -0.3))])
def test_shadow_of_a_box_in_both_views(tilts) -> None:
    """Ground points within 0.5 m of the box's shadow's edge are left out of the comparison."""
    half, roof = 8.0, 30.0
    model = model_of(*tilts)
    points = plane_with_box(half, roof)
    rng = np.random.default_rng(1)
    east, north = rng.uniform(-30, 30, (2, 4000))
    outside = (abs(east) > half + 0.7) | (abs(north) > half + 0.7)
    east, north = east[outside], north[outside]
    found = verdicts(model, points, east, north, HEIGHT)
    expected = {}
    for margin in (-1.0, 1.0):  # box shrunk and grown by a metre
        h = np.linspace(0, roof, 400)[:, None]
        expected[margin] = [
            (
                (abs(east - tilt[0] * h) < half + margin)
                & (abs(north - tilt[1] * h) < half + margin)
            ).any(axis=0)
            for tilt in tilts
        ]
    surely, perhaps = expected[-1.0], expected[1.0]
    assert surely[0].sum() + surely[1].sum() > 150
    assert (found[surely[0]] == 1).all()
    assert (found[surely[1] & ~perhaps[0]] == 2).all()
    assert (found[~perhaps[0] & ~perhaps[1]] == 0).all()


def test_slopes_hide_themselves_only_beyond_the_ray() -> None:
    """A slope facing away from the forward camera, whose rays rise by 63.9 degrees.

    Cells hold one or two points each, so that verdicts near that angle are uncertain.
    """
    model = model_of((0.0, 0.09), (0.0, -0.49))
    rng = np.random.default_rng(2)
    for degrees, hidden in ((0, False), (30, False), (48, False), (70, True)):
        east, north = rng.uniform(-30, 30, (2, 60_000))
        slope = np.tan(np.radians(degrees))
        # Its ray runs north: ground that rises to the north comes into its way.
        height = HEIGHT + slope * (north + 30)
        points = points_at(east, north, height)
        probe = abs(north) < 10
        found = verdicts(model, points, east[probe][:300], north[probe][:300], height[probe][:300])
        assert (found == 2).mean() == pytest.approx(float(hidden), abs=0.01), degrees


def test_flat_and_noisy_ground_is_seen() -> None:
    rng = np.random.default_rng(4)
    points = plane_with_box(0.0, 0.0)
    noisy = Points(
        points.lon_q,
        points.lat_q,
        points.h_q + rng.integers(-1000, 1001, len(points)),  # 0.1 m
        points.classification,
        points.return_number,
        points.number_of_returns,
    )
    east, north = rng.uniform(-40, 40, (2, 2000))
    assert (verdicts(model_of(), noisy, east, north, HEIGHT) == 0).all()


def test_surface_has_no_small_holes_and_no_grown_roofs() -> None:
    model = model_of()
    rays = Rays.of(model)
    points = plane_with_box(8.0, 30.0, spacing=0.8)
    surface = build_surface(points, rays)
    inner = surface.height[5:-5, 5:-5]
    assert np.isfinite(inner).all()
    roof = (inner > HEIGHT + 15).sum() * 0.325**2
    assert roof == pytest.approx(16.0**2, rel=0.15)
    empty = SurfaceBuilder(rays, (0, 0), (900, 900)).built()
    assert (empty.height == -np.inf).all() and (empty.ceiling == -np.inf).all()


def test_a_cell_is_as_high_as_the_mean_of_its_top() -> None:
    """Every cell with points, against their definition in Python: 1e-4 m, as float32."""
    rays = Rays.of(model_of())
    rng = np.random.default_rng(5)
    east, north = rng.uniform(-15, 15, (2, 20_000))
    points = points_at(east, north, HEIGHT + rng.choice([0.0, 0.5, 4.0], east.size))
    surface = build_surface(points, rays)
    cells: dict[tuple[int, int], list[int]] = {}
    for lon, lat, h in zip(points.lon_q, points.lat_q, points.h_q):
        cells.setdefault((lat // rays.cell[1], lon // rays.cell[0]), []).append(h)
    assert len(cells) > 5000
    for (row, col), heights in cells.items():
        h = np.array(heights) / 1e4
        expected = h[h >= h.max() - SURFACE_PX / rays.px_per_m].mean()
        found = surface.height[row - surface.row, col - surface.col]
        assert found == pytest.approx(expected, abs=1e-4)
