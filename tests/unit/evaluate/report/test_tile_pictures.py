"""Pictures of a tile."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.products.rasters import write_tiff
from stereotruth.core.status import Status
from stereotruth.evaluate.report import tile_pictures
from stereotruth.pages.pictures import NO_VALUE
from stereotruth.tiles.quick_looks import SPLIT_COLOURS, status_colours

from ....synthetic.colour_vision import nearest, rgb
from ....synthetic.reported_city import FLAGS, SHIFT, SIZE, picture, write_city

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

LARGE = SIZE, 10**6
LIMITS_PX = 0.0, 20.0


def test_the_right_image_warps_onto_the_left_and_leaves_no_difference(tmp_path):
    rows = write_city(tmp_path, 1)
    made = tile_pictures.tile_pictures(
        tmp_path, rows[0], thumbnail=(SIZE, 10**6), large=LARGE, limits_px=LIMITS_PX
    )
    counts = tile_pictures.disparity_counts(tmp_path, rows[0])
    assert counts == {SHIFT: SIZE**2 - 600}
    assert tile_pictures.disparity_limits([counts, {40: 1}]) == (SHIFT, SHIFT + 1)
    assert tuple(made.layers) == tile_pictures.LARGE
    assert made.disparity_px == (SHIFT, SHIFT)
    assert made.correlation == pytest.approx(1.0)
    left, warped = (picture(made.layers[name].uri) for name in ("left", "warped right"))
    inner = np.s_[40:, 2 * SHIFT : -SHIFT]
    assert np.abs(left - warped)[inner].mean() < 3  # grey values: compression
    assert left[inner].std() > 20
    difference = picture(made.layers["left − warped right"].uri)
    assert difference[inner].min() > 235
    assert np.abs(warped[15:25, 26:44] - tile_pictures.NO_MATCH).max() < 25
    assert np.abs(difference[15:25, 26:44] - NO_VALUE).max() < 25
    status = picture(made.uris["status"])
    colours = status_colours(list(FLAGS.values()))
    for place, name in ((status[60:, 60:], "labelled"), (status[15:25, 26:44], "a_new_reason")):
        assert np.abs(place - tuple(bytes.fromhex(colours[name][1:]))).max() < 25


def test_a_wrong_disparity_shows_in_the_difference(tmp_path):
    rows = write_city(tmp_path, 1)
    write_tiff(tmp_path / rows[0]["disp"], np.full((SIZE, SIZE), 4, np.float32), nodata=-999)
    made = tile_pictures.tile_pictures(
        tmp_path, rows[0], thumbnail=(9, 10**6), large=LARGE, limits_px=LIMITS_PX
    )
    assert made.correlation < 0.9
    assert picture(made.layers["left − warped right"].uri)[40:, 20:80].min(axis=2).mean() < 150


def test_colours_of_status_and_splits_are_apart_for_all_eyes():
    assert nearest([rgb(status.colour) for status in Status]) > 20
    assert nearest([rgb(colour) for colour in SPLIT_COLOURS.values()]) > 20
