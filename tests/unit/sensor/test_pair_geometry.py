"""Which image of a pair looks backward, and what ground images show."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.sensor.pair_geometry import GroundOfImages, view_order

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, camera

OVERLAP = np.array([[100.0, 200.0], [100.0, 200.0]])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("left", "right", "order"),
    [
        (BACKWARD, FORWARD, "left looks backward"),
        (FORWARD, BACKWARD, "left looks forward"),
        (BACKWARD, BACKWARD, "across track"),  # an image and its copy: neither
    ],
)
def test_the_view_that_looks_backward_is_told(left, right, order) -> None:
    assert view_order(camera(left), camera(right), OVERLAP, HEIGHT) == order


def test_images_show_the_ground_in_their_frames_and_boxes_around_it() -> None:
    ground = GroundOfImages([camera(BACKWARD)], [(6000, 5000)])
    west, south, east, north = ground.box((HEIGHT - 50.0, HEIGHT + 50.0))
    assert west < LON < east and south < LAT < north
    lon, lat = np.array([LON, LON + 1.0]), np.array([LAT, LAT])
    assert ground.shows(lon, lat, np.full(2, HEIGHT)).tolist() == [True, False]
    boxes = np.array(
        [[LON - 2, LAT - 2, 0, LON + 2, LAT + 2, 900], [LON + 1, LAT, 0, LON + 2, LAT, 9]]
    )
    assert ground.may_show(boxes).tolist() == [True, False]
    assert ground.pixel_deg[1] * 111_320 == pytest.approx(0.65, rel=0.1)
