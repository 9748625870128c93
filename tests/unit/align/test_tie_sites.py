"""Windows of one surface alone: planes among crowns, and pixels that show nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.align.tie_sites import AROUND, GUARDS, HALF, SIDE, SITE, SiteSurface
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.shown_ground import GroundOfImages
from stereotruth.surface.image_surface import ImageProjection
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell
from stereotruth.surface.surface_store import SurfaceStore

from ...synthetic.box_scene import HALF as BOX
from ...synthetic.box_scene import ROOF, points_on, write_points
from ...synthetic.cameras import HEIGHT, LAT, LON, METRES
from ...synthetic.textured_pair import SIZE, TRUE

WIDE = 60
CENTRE = np.array([30, 30])
PARALLAX = np.array([-0.2, 0.9])  # px/m
LEVEL, SLOPES = 50.0, np.array([0.11, -0.06])  # m, m/px
COL, ROW = np.meshgrid(np.arange(WIDE), np.arange(WIDE))
PLANE = LEVEL + (COL - CENTRE[0]) * SLOPES[0] + (ROW - CENTRE[1]) * SLOPES[1]


def site(left: np.ndarray, right: np.ndarray) -> SiteSurface:
    """Of images in which places of the plane have the same position."""
    design = np.eye(2) - np.outer(PARALLAX, SLOPES)
    offset = -PARALLAX * (LEVEL - SLOPES @ CENTRE)
    return SiteSurface(left, right, np.column_stack([design, PARALLAX, offset]))


def test_a_third_of_crowns_does_not_tilt_a_plane():
    rng = np.random.default_rng(7)
    crown = np.hypot(COL - 35, ROW - 26) < 6.3
    height = PLANE + rng.normal(0, 0.03, PLANE.shape) + crown * rng.uniform(2, 5, PLANE.shape)
    planes, share = site(height, height).fit_planes(CENTRE[None])
    inside = np.maximum(np.abs(COL - 30), np.abs(ROW - 30)) <= HALF
    assert planes[0, 0] == pytest.approx(LEVEL, abs=0.03)
    assert planes[0, 1:3] == pytest.approx(SLOPES, abs=0.006)
    assert planes[0, 3] == pytest.approx(0.03, rel=0.5)
    assert share[0] == pytest.approx(1.0 - crown[inside].mean(), abs=0.06)


def test_crowns_all_over_are_no_plane_to_match_on():
    rough = LEVEL + np.random.default_rng(8).uniform(0, 4, PLANE.shape)
    planes, _ = site(rough, rough).fit_planes(CENTRE[None])
    assert not planes[0, 3] < 0.5


def test_what_stands_off_the_plane_is_left_out_where_either_view_shows_it():
    """A pole 5 m above the plane: at (0, -5) in the left image, at (-1, -0.5) in the right one."""
    left, right = PLANE.copy(), PLANE.copy()
    left[25, 30] += 5.0
    right[29:31, 29] += 5.0
    left[38, 22] = np.nan  # and what the surface does not say
    planes, _ = site(left, right).fit_planes(CENTRE[None])
    assert planes[0, :3] == pytest.approx([LEVEL, *SLOPES], abs=1e-6)
    clear = site(left, right).clear_pixels(CENTRE[None], planes)[:, 0]
    row, col = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    for one, guard in zip(clear, GUARDS):
        off = [(0, -5), (-1, -1), (-1, 0), (-8, 8)]
        away = np.min([np.hypot(col - x, row - y) for x, y in off], axis=0)
        assert one.shape == (SIDE, SIDE)
        assert (one == (away > guard.px)).all()


def test_both_images_show_the_roof_and_the_ground_where_cameras_see_them(tmp_path):
    """The height that the surface has at a place is that which the exact box has there."""
    store = write_points(tmp_path, points_on(True, noise=0.03))
    ground = GroundOfImages(TRUE, [SIZE, SIZE])
    make_surface(open_stores([store]), tmp_path / "s", cell=ground_cell(ground.pixel_deg))
    middle = np.array(TRUE[0].project(LON, LAT, HEIGHT))
    corner = (middle - SITE / 2).astype(int)
    projections = [ImageProjection(sensor, 0.65) for sensor in TRUE]
    shown = SiteSurface.of(*projections, SurfaceStore(tmp_path / "s"), (*corner, HEIGHT, ROOF))
    row, col = np.nonzero(np.isfinite(shown.left))
    height = shown.left[row, col]
    assert height.size > 0.8 * shown.left.size
    at = np.stack([col, row], axis=1) + corner - AROUND
    lon, lat = TRUE[0].localize(*at.T, height)
    beyond = np.stack([np.abs(lon - LON), np.abs(lat - LAT)], axis=1) * METRES - BOX
    inside, away = (beyond < 0).all(axis=1), np.abs(beyond.max(axis=1)) > 1.0
    true = np.where(inside, ROOF, HEIGHT)
    assert (np.abs(height - true)[away] < 0.2).mean() > 0.999
    design = np.column_stack([col, row, height, np.ones(col.size)])
    there = np.rint(design @ shown.to_right.T).astype(int)
    in_right = shown.right[there[:, 1], there[:, 0]]
    seen = np.isfinite(in_right) & away
    assert seen.mean() > 0.6
    # but for the ground that the roof hides from the right camera
    assert (np.abs(in_right - height)[seen] < 0.2).mean() > 0.85
    roof = seen & inside
    assert roof.sum() > 100 and (np.abs(in_right - height)[roof] < 0.2).mean() > 0.99
