"""Charts of a city's page and pictures of its tiles: marks and colours are where the values are."""

from __future__ import annotations

import base64
import csv
import io
import re

import numpy as np
import pytest

from stereotruth.evaluate.report import city_pictures
from stereotruth.evaluate.report.city_pictures import histograms, tile_map
from stereotruth.pages.pictures import NO_VALUE
from stereotruth.tiles.quick_looks import feature, status_colours, write_footprints

from ....synthetic.reported_city import FLAGS, SHIFT, SIZE, picture, write_city

LAT = 45.0


def rows_of(chart):
    text = base64.b64decode(chart.csv.partition(",")[2]).decode()
    return list(csv.DictReader(io.StringIO(text)))


def tile(name, number, **values):
    columns = ("city", "scene", "class", "left", "right", "disp", "labelled_share",
               "disparity_min_px", "disparity_mean_px", "disparity_max_px")  # fmt: skip
    row = dict.fromkeys(columns, "") | {"tile": name, "number": str(number), "split": "train"}
    return row | {"complete": "yes", "quality": "ok", "right_offset_px": "0"} | values


def test_tiles_lie_north_up_in_metres_and_lead_to_their_pictures(tmp_path):
    rows = [tile("A_0", 0), tile("A_1", 1, quality="min_sift_matches")]
    square = np.array([[0, 0], [0.01, 0], [0.01, 0.01], [0, 0.01]]) + np.array([5.0, LAT])
    rings = square, square + np.array([0.02, 0.01])  # to the north-east
    write_footprints(tmp_path, [feature(row, ring) for row, ring in zip(rows, rings)])
    chart = tile_map(tmp_path, rows, [], 1000)
    shapes = {
        name: np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", path), float)
        for path, name in re.findall(r'<path d="([^"]*)" [^>]*><title>(\w+): train', chart.svg)
    }
    assert set(shapes) == {"A_0", "A_1"}
    assert shapes["A_1"][:, 0].min() > shapes["A_0"][:, 0].max()  # east is right
    assert shapes["A_1"][:, 1].min() < shapes["A_0"][:, 1].min()  # north is up
    wide, high = np.ptp(shapes["A_0"], axis=0)
    assert abs(wide / high - np.cos(np.radians(LAT))) < 0.01
    assert 'href="#tile-A_0"' in chart.svg and "misses a limit" in chart.svg
    assert tile_map(tmp_path / "nothing", rows, [], 1000) is None


def test_histograms_count_what_they_are_given_on_one_axis():
    chart = histograms("h", {"train": {-2: 10, 3: 30}, "val": {3: 5}, "test": {}})
    shares = {(row["of"], int(row["from_px"])): float(row["percent_per_px"])
              for row in rows_of(chart)}  # fmt: skip
    assert shares[("train", -2)] == 25 and shares[("train", 3)] == 75
    assert shares[("val", 3)] == 100 and shares[("val", -2)] == 0
    assert not any(of == "test" for of, _ in shares)
    assert histograms("h", {"train": {}}) is None


pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

LARGE = SIZE, 10**6
LIMITS_PX = 0.0, 20.0


def test_the_right_image_warps_onto_the_left_and_leaves_no_difference(tmp_path):
    rows = write_city(tmp_path, 1)
    made = city_pictures.tile_pictures(
        tmp_path, rows[0], thumbnail=(SIZE, 10**6), large=LARGE, limits_px=LIMITS_PX
    )
    counts = city_pictures.disparity_counts(tmp_path, rows[0])
    assert counts == {SHIFT: SIZE**2 - 600}
    assert city_pictures.disparity_limits([counts, {40: 1}]) == (SHIFT, SHIFT + 1)
    assert tuple(made.layers) == city_pictures.LARGE
    assert made.disparity_px == (SHIFT, SHIFT)
    assert made.correlation == pytest.approx(1.0)
    left, warped = (picture(made.layers[name].uri) for name in ("left", "warped right"))
    inner = np.s_[40:, 2 * SHIFT : -SHIFT]
    assert np.abs(left - warped)[inner].mean() < 3  # grey values: compression
    assert left[inner].std() > 20
    difference = picture(made.layers["left − warped right"].uri)
    assert difference[inner].min() > 235
    assert np.abs(warped[15:25, 26:44] - city_pictures.NO_MATCH).max() < 25
    assert np.abs(difference[15:25, 26:44] - NO_VALUE).max() < 25
    status = picture(made.uris["status"])
    colours = status_colours(list(FLAGS.values()))
    for place, name in ((status[60:, 60:], "labelled"), (status[15:25, 26:44], "a_new_reason")):
        assert np.abs(place - tuple(bytes.fromhex(colours[name][1:]))).max() < 25
