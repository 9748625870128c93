"""Charts: marks where the values are, with texts, links and a CSV."""

from __future__ import annotations

import base64
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from stereotruth.pages.figures import AXES, DASHES, MARKERS, Plot, look, styled
from stereotruth.pages.pictures import SERIES

from ...browser import needs_chromium, screenshot
from ...synthetic.colour_vision import rgb

WHITE, DARK = (255, 255, 255), (20, 24, 30)


@styled
def scattered(texts, links=()):
    plot = Plot.of("a < b", "Of $x", (4, 3))
    style = look(0) | {"linestyle": "none"}
    (marks,) = plot.axis.plot([0, 1, 2], [0, 10, 5], **style)
    plot.hover(marks, texts, links)
    plot.axis.set(xlabel="$a_{ <b>")
    return plot.chart([{"x": 0, "y": 1.5}])


def test_each_mark_says_what_it_is_and_leads_somewhere():
    chart = scattered(["A", "B <i>", "C"], ["", "#b", ""])
    root = ElementTree.fromstring(chart.svg)
    assert [title.text for title in root.iter("title")] == ["A", "B <i>", "C"]
    (link,) = root.iter("a")
    assert link.get("href") == "#b" and link.find(".//title").text == "B <i>"
    x, y = zip(*((float(mark.get("x")), float(mark.get("y"))) for mark in titled(root)))
    assert x[0] < x[1] < x[2] and y[1] < y[2] < y[0]  # y down
    assert base64.b64decode(chart.csv.partition(",")[2]) == b"x,y\n0,1.5\n"


def titled(root):
    return [mark for mark in root.iter("use") if mark.find("title") is not None]


def test_texts_are_no_formulas_and_equal_input_gives_equal_bytes():
    chart = scattered(["A", "B", "C"])
    assert "$a_{ &lt;b&gt;" in chart.svg
    assert chart == scattered(["A", "B", "C"])
    assert "http" not in chart.svg  # asks for nothing


@pytest.mark.parametrize("back", [WHITE, DARK])
def test_colours_have_a_contrast_of_3_to_light_and_dark_pages(back):
    for colour in (*SERIES, AXES):
        high, low = sorted((luminance(rgb(colour)), luminance(back)), reverse=True)
        assert (high + 0.05) / (low + 0.05) >= 3.0


def luminance(colour):
    c = np.array(colour) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_series_differ_in_more_than_colour():
    looks = [look(k) for k in range(len(SERIES))]
    for key in ("color", "marker", "linestyle"):
        assert len({str(of[key]) for of in looks}) == len(SERIES) == len(DASHES) == len(MARKERS)


@needs_chromium
def test_pictures_stand_upright(tmp_path):
    """The first row of a picture is its top."""
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:4, :4, 0] = 255  # red at the top left
    page = tmp_path / "page.html"
    page.write_text(f"<body>{shown(picture).svg}</body>")
    image = cv2.imread(str(screenshot(page, tmp_path / "page.png", 600, 600))).astype(int)
    red = (image[..., 2] > 200) & (image[..., :2].max(axis=2) < 60)
    black = image.max(axis=2) < 60
    assert red.sum() > 10_000
    for axis in (0, 1):  # above and to the left of what is black
        assert np.nonzero(red)[axis].mean() < np.nonzero(black)[axis].mean()


@styled
def shown(picture):
    plot = Plot.of("map", "", (4, 4))
    plot.picture(plot.axis, picture, (0, 10, 0, 10), 10_000)
    plot.axis.set(xlim=(0, 10), ylim=(0, 10))
    return plot.chart()
