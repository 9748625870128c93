"""The map of tiles on the ground, histograms, calibration: marks are where the values are."""

from __future__ import annotations

import base64
import csv
import io
import re

import numpy as np

from stereotruth.evaluate.report.maps import calibration, histograms, tile_map
from stereotruth.tiles.quick_looks import feature, write_footprints

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


def test_calibration_has_a_mark_for_each_group():
    groups = [
        {"mean_uncertainty": s, "share_below_1": a, "share_below_2": 0.9}
        for s, a in ((0.1, 0.5), (0.4, 0.7))
    ]
    chart = calibration(groups, "caption")
    once = re.findall(r'y="([\d.]+)"[^>]*><title>[^<]*below once', chart.svg)
    assert len(once) == 2 and float(once[1]) < float(once[0])  # a larger share stands higher
    assert calibration([], "") is None
