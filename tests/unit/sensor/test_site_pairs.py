"""Pairs of images: their geometry by simulated cameras, their light, their rank, their links."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from stereocities.camera import rays
from stereocities.sites import camera_of, drawn_site
from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.sensor.deliveries import Acquisition, by_sheet, sun_over
from stereotruth.sensor.rpc import RPC, SensorModel
from stereotruth.sensor.site_pairs import (
    USUAL_ROUGHNESS_M,
    Links,
    PairLight,
    SiteImage,
    SitePair,
    angles_of,
    new_links,
    pair_light,
    pair_of,
    pairs_of_site,
    quality_of,
)

from ...synthetic.site_sensors import exact_image


def ray(off_nadir: float, azimuth: float) -> np.ndarray:
    lean, turn = np.radians([off_nadir, azimuth])
    return np.array([np.sin(lean) * np.sin(turn), np.sin(lean) * np.cos(turn), np.cos(lean)])


@pytest.mark.parametrize(
    ("one", "other", "angles"),
    [
        ((10, 0), (20, 180), (30, 85, 5)),  # in one vertical plane
        ((20, 90), (20, 270), (40, 90, 0)),
        ((20, 80), (20, 100), (6.8, 70.3, 0)),  # both look east: an oblique plane
    ],
)
def test_angles_of_a_pair(one, other, angles):
    assert angles_of((ray(*one), ray(*other))) == pytest.approx(angles, abs=0.06)
    assert angles_of((ray(*other), ray(*one))) == pytest.approx(angles, abs=0.06)


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


# ------------------------------------------------------------------ light


DAY = datetime(2020, 6, 1, 3, tzinfo=UTC)
PLACE = (114.0, 30.0)


def taken(after: timedelta) -> Acquisition:
    return Acquisition(DAY + after, sun_over(DAY + after, *PLACE))


def light(other: Acquisition, **told: bool) -> PairLight:
    return pair_light(taken(timedelta()), other, 0.7, **told)


@pytest.mark.parametrize(
    ("after", "diachronic", "by"),
    [
        (timedelta(seconds=40), False, "suns"),  # one pass
        (timedelta(minutes=90), True, "suns"),  # one day, two satellites
        (timedelta(days=20, minutes=30), True, "suns"),
        (timedelta(days=40), True, "days"),
    ],
)
def test_suns_decide_within_a_month(after: timedelta, diachronic: bool, by: str) -> None:
    found = light(taken(after))
    assert (found.diachronic, found.decided_by) == (diachronic, by)
    other = light(taken(after), told=not diachronic)
    assert (other.diachronic, other.decided_by) == (not diachronic, "scenes sheet")


def test_a_shadow_of_ten_metres_moves_by_its_pixels() -> None:
    suns = Acquisition(None, (180.0, 45.0)), Acquisition(None, (180.0, 40.0))
    found = pair_light(*suns, 0.5)
    assert found.shadow_px == pytest.approx(10 * (1.1918 - 1) / 0.5, abs=0.01)
    assert (found.sun_angle_deg, found.days, found.diachronic) == (5.0, None, True)
    assert not pair_light(*suns, 5.0).diachronic  # large pixels


def test_without_a_sun_days_alone_tell() -> None:
    unknown, default = Acquisition(), True

    def dated(day: int) -> Acquisition:
        return by_sheet(unknown, (DAY + timedelta(days=day)).date(), None, PLACE)

    assert dated(0).sun is None
    near, far = (light(dated(day), default=default) for day in (5, 31))
    assert (near.diachronic, near.decided_by) == (default, "configuration")
    assert (far.diachronic, far.decided_by) == (True, "days")
    assert light(unknown, default=default).diachronic == default


# ------------------------------------------------------------------ rank


GOOD = SitePair(
    "A", "B", 1.0, 1.0, convergence=12.0, bisector=85.0, asymmetry=3.0, off_nadir=12.0,
    pixel_ratio=1.0, pixel_m=0.5, sun=0.1, shadow=0.0, days=0.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"), [({"convergence": 40.0}, "hidden"), ({"shadow": 1.2}, "shadows")]
)
def test_what_parts_two_images_lowers_the_prediction_and_is_named(change, words):
    worse = quality_of(replace(GOOD, **change))
    assert worse.matched < quality_of(GOOD).matched - 0.05
    assert words in worse.reason


def test_what_stands_on_a_site_lowers_the_prediction_of_all_its_pairs():
    usual = quality_of(GOOD, USUAL_ROUGHNESS_M)
    assert usual == quality_of(GOOD)
    assert quality_of(GOOD, 2.0).matched < usual.matched < quality_of(GOOD, 0.8).matched
    assert quality_of(GOOD, 0.0).matched == quality_of(GOOD, 0.05).matched < 1.0


def test_pairs_of_middling_convergence_give_most():
    """Narrow pairs match and tell little, wide ones tell much where they match."""
    bits = [quality_of(replace(GOOD, convergence=angle)).bits for angle in (3, 5, 20, 60, 80)]
    assert bits[0] < bits[1] < bits[2] > bits[3] > bits[4]
    fine = quality_of(replace(GOOD, pixel_m=0.3))
    assert fine.bits > quality_of(GOOD).bits and fine.matched == quality_of(GOOD).matched


# ------------------------------------------------------------------ links


def test_groups_and_unused_images_are_named() -> None:
    links = Links.of("ABCDEFG", [("C", "B"), ("A", "B"), ("E", "F")])
    assert links.groups == (("A", "B", "C"), ("E", "F")) and links.unused == ("D", "G")
    assert len(links.sentences) == 2
    assert Links.of("ABC", [("A", "B"), ("C", "A")]).sentences == []


def test_new_links_are_the_first_that_link_anything() -> None:
    pairs = [("A", "B"), ("B", "C"), ("A", "C"), ("C", "D")]
    assert new_links(pairs) == [pairs[0], pairs[1], pairs[3]]
    assert new_links(pairs, [("A", "C")]) == [pairs[0], pairs[3]]
