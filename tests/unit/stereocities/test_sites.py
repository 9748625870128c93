"""Images of a site at their own dates and suns: their truth, control points in the long form."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from stereocities.camera import project, rays
from stereocities.layout import frame_of
from stereocities.sites import (
    LOWEST_SUN_DEG,
    camera_of,
    drawn_site,
    image_truth,
    pair_truth,
    site_points,
    sun_at,
)
from stereotruth.project.simulated_project import SITE


@pytest.fixture(scope="module")
def site():
    return drawn_site(3, 11, images=4, side_px=160)


def test_the_sun_is_that_of_nrel_s_example():
    """Reda and Andreas 2004, table A5.1; refraction, 0.016 degrees there, is left out."""
    azimuth, elevation = sun_at(
        datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), -105.1786, 39.742476
    )
    assert azimuth == pytest.approx(194.340, abs=0.01)
    assert elevation == pytest.approx(90 - 50.112 - 0.016, abs=0.01)


def test_each_image_has_a_date_and_the_sun_of_it(site):
    more = drawn_site(3, 11, images=6, side_px=160)
    assert more.images[:4] == site.images and more.city == site.city
    for image in site.images:
        assert image.sun_deg == sun_at(image.acquired, site.city.lon, site.city.lat)
        assert image.sun_deg[1] > LOWEST_SUN_DEG
        camera = camera_of(site, image)
        assert np.degrees(np.arcsin(camera.surfaces.sun[2])) == pytest.approx(image.sun_deg[1])
        origin, toward = rays(camera.cam, [[(image.cols - 1) / 2, (image.rows - 1) / 2]])
        ground = origin - origin[:, 2:] * toward
        assert np.hypot(*ground[0, :2]) < 40  # of ground that is some metres above the frame's
    one, other = drawn_site(0, 2026, images=2, side_px=160).images
    assert one.aside_m == other.aside_m  # one pass: the sooner image looks farther ahead
    assert (one.look_deg > other.look_deg) == (one.acquired < other.acquired)
    assert abs(one.acquired - other.acquired) < timedelta(minutes=5)


def test_the_truth_of_a_pair_agrees_with_that_of_each_image(site):
    """What the left image shows at a pixel, the right one has at the place that the truth names."""
    left, right = site.images[:2]
    row, col = np.mgrid[20:140:9, 20:140:9].astype(float)
    pair = pair_truth(site, left, right, col, row)
    seen = pair["visible_right"] > 0
    assert seen.mean() > 0.5
    here = image_truth(site, left, col, row)
    there = image_truth(site, right, pair["right_col"][seen], pair["right_row"][seen])
    for name, limit in (("lon", 3e-7), ("lat", 3e-7), ("height", 0.02)):
        np.testing.assert_array_equal(here[name], pair[name])
        np.testing.assert_allclose(there[name], pair[name][seen], atol=limit)
    hidden = pair["hidden_right"] > 0
    covered = image_truth(site, right, pair["right_col"][hidden], pair["right_row"][hidden])
    assert (covered["height"] > pair["height"][hidden] - 0.02).all()


def test_control_points_stand_in_the_long_form_where_images_show_them():
    measured, exact = site_points(SITE, seed=1)
    assert len(measured) == len(exact) > 60
    per_point = {}
    for row in exact:
        per_point.setdefault(row["id"], []).append(row["image"])
        camera = camera_of(SITE, SITE.image(row["image"]))
        ground = np.array([[float(row[k]) for k in ("lon", "lat", "height")]])
        at = project(camera.cam, frame_of(SITE.city).from_geodetic(ground))[0]
        np.testing.assert_allclose(at, [float(row["col"]), float(row["row"])], atol=1e-3)
    assert all(len(images) == len(set(images)) >= 2 for images in per_point.values())
    noise = [float(a[k]) - float(b[k]) for a, b in zip(measured, exact) for k in ("col", "row")]
    assert 0.2 < np.std(noise) < 0.3
