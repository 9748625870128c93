"""Arrows, histograms and calibration as drawings."""

from __future__ import annotations

import json
import re

import pytest

from stereotruth.report import drawings

from ...synthetic.reported_city import alignment

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_calibrated_groups_lie_on_the_lines():
    deciles = [
        {"mean_uncertainty": sigma, "share_below_1": once, "share_below_2": twice}
        for sigma, once, twice in ((0.1, 0.683, 0.954), (0.3, 0.25, 1.0))
    ]
    drawn = drawings.calibration(deciles, "caption")
    once, twice, right = drawn.series
    lines = [float(y) for y in re.findall(r"M0 ([\d.]+)H", right.path)]
    assert lines == pytest.approx([once.points[0].y, twice.points[0].y], abs=0.11)
    wrong = once.points[1]
    assert (wrong.x, wrong.y) == (0.75 * drawings.WIDTH, 0.75 * drawings.HEIGHT)
    assert twice.points[1].y == 0.0
    assert [text for _, text in drawn.x_ticks] == ["0.100", "0.300"]
    assert drawings.calibration([], "") is None


def test_arrows_have_the_length_of_their_key(tmp_path):
    record = json.loads(alignment(tmp_path / "a.json").read_text())
    view = record["left"]
    longest = drawings.longest_residual(view["gcps"], "before")
    assert longest == 10.0  # not that of the point left out
    frame = drawings.arrow_frame("", view["size"], view["gcps"], "before", longest)
    assert frame.key_px == 10.0
    per_px = frame.key_length / frame.key_px
    first, second, out = frame.arrows
    assert (first.dx / per_px, first.dy / per_px) == pytest.approx((3, 4), abs=0.05)
    assert (second.dx / per_px, second.dy / per_px) == pytest.approx((-6, 8), abs=0.05)
    assert (first.x, first.y) == (150.0, 75.0)  # 100, 50 of 200 px in a frame of 300
    assert not out.used and out.dx == pytest.approx(
        20 * per_px, abs=0.1
    )  # cut to twice the longest


def test_histograms_share_their_axis_and_keep_every_label():
    one, two = {0: 10, 5: 30}, {-40: 60, 59: 20}
    first, second = drawings.histograms([("one", "red", one), ("two", "red", two)])
    assert first.caption == "0.00 million labels, mean 4.2 px"
    assert second.caption.endswith("mean −14.8 px")
    assert first.x_ticks == second.x_ticks
    bar = drawings.WIDTH / 50  # px of two: −40 … 60
    path = first.series[0].path
    heights = [float(y) for y in re.findall(r"V([\d.]+)H", path)]
    assert len(heights) == 50
    assert heights[20] == pytest.approx(drawings.HEIGHT * (1 - 10 / 30), abs=0.1)
    assert heights[22] == 0
    assert re.findall(r"H([\d.]+)", path)[0] == f"{bar:g}"
    assert [text for _, text in first.y_ticks] == ["30"]  # % per px, of 75 in 2 px
