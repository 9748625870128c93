from __future__ import annotations

import numpy as np
import pytest

from stereocities.camera import rays
from stereocities.sites import camera_of, drawn_site
from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.sensor.rpc import RPC, SensorModel
from stereotruth.sensor.site_pairs import SiteImage, angles_of, pair_of, pairs_of_site

from ...synthetic.site_sensors import exact_image


def ray(off_nadir: float, azimuth: float) -> np.ndarray:
    lean, turn = np.radians([off_nadir, azimuth])
    return np.array([np.sin(lean) * np.sin(turn), np.sin(lean) * np.cos(turn), np.cos(lean)])


@pytest.mark.parametrize(
    ("one", "other", "angles"),
    [
        ((10, 0), (20, 180), (30, 85, 5)),  # in one vertical plane
        ((20, 90), (20, 270), (40, 90, 0)),
        ((0, 0), (25, 70), (25, 77.5, 12.5)),
        ((20, 80), (20, 100), (6.8, 70.3, 0)),  # both look east: an oblique plane
    ],
)
def test_angles_of_a_pair(one, other, angles):
    assert angles_of((ray(*one), ray(*other))) == pytest.approx(angles, abs=0.06)
    assert angles_of((ray(*other), ray(*one))) == pytest.approx(angles, abs=0.06)


def test_one_direction_has_no_convergence():
    assert angles_of((ray(20, 80), ray(20, 80))) == pytest.approx((0, 70, 0))


@pytest.fixture(scope="module")
def site():
    return drawn_site(3, 11, images=4, side_px=160)


@pytest.fixture(scope="module")
def images(site):
    return [exact_image(site, image) for image in site.images]


def test_the_angles_of_simulated_cameras_are_found_from_their_rpcs(site, images):
    pairs = pairs_of_site(images)
    assert len(pairs) == 6
    for pair in pairs:
        toward = []
        for name in (pair.left, pair.right):
            image = site.image(name)
            _, down = rays(
                camera_of(site, image).cam, [[(image.cols - 1) / 2, (image.rows - 1) / 2]]
            )
            toward.append(down[0] / np.linalg.norm(down[0]))
        expected = np.degrees(np.arccos(toward[0] @ toward[1]))
        assert pair.convergence == pytest.approx(expected, abs=0.3)
        assert pair.off_nadir == pytest.approx(
            max(np.degrees(np.arccos(ray[2])) for ray in toward), abs=0.3
        )
        days = abs((site.image(pair.left).acquired - site.image(pair.right).acquired).days)
        assert pair.days == pytest.approx(days, abs=1)
        assert 0.5 < pair.shared <= 1
        assert pair.pixel_m == pytest.approx(0.6, rel=0.2)


def test_the_order_of_the_images_plays_no_part(images):
    assert pairs_of_site(images) == pairs_of_site(images[::-1])


def test_left_is_the_backward_view():
    site = drawn_site(0, 2026, images=2, side_px=160)  # of one pass
    back, ahead = sorted(site.images, key=lambda image: image.look_deg)
    (pair,) = pairs_of_site([exact_image(site, image) for image in site.images])
    assert (pair.left, pair.right) == (back.name, ahead.name)


def test_what_shares_no_ground_is_no_pair(images):
    one, other = images[:2]
    rpc = other.sensor.rpc
    moved = RPC.from_dict(rpc.to_dict() | {"long_off": rpc.long_off + 500 / DEGREE_M})
    away = SiteImage("away", SensorModel(moved), other.size)
    assert pair_of(one, away, 0.0) is None
    near = pair_of(one, SiteImage("near", SensorModel(rpc), other.size), rpc.height_off)
    assert near.days is None and near.sun is None and near.shadow is None
