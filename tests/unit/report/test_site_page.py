"""The page of a site, from pairs and records made by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereotruth.report.site_page import Pair, SiteImage, write_site_page

from ...browser import look, needs_chromium

IMAGES = [
    SiteImage(
        "A",
        "2024-01-02",
        [(10.0, 50.01), (10.02, 50.01), (10.02, 50.0), (10.0, 50.0)],
        12.34,
        (150.04, 40.0),
    ),
    SiteImage("<b>", "", [(10.01, 50.01), (10.03, 50.01), (10.03, 50.0), (10.01, 50.0)]),
]
PAIRS = [
    Pair("A", "<b>", 0.9, 20.0, 0.0, "alike", "A-b"),
    Pair("A", "C", 0.5, 10.0, 40.0, "shadows", ""),
    Pair("A", "D", 0.1, 30.0, None, "unknown", ""),
]
ADJUSTED = {
    "images": {
        "A": {
            "gcps": {"count": 5, "used": 4, "before": 6.0, "after": 0.25, "leave_one_out": None},
            "ties": {"used": 70, "disparity": {"rms": 0.11}, "y_parallax": {"rms": 0.08}},
            "sigma": 0.02,
            "refused": "",
            "doubts": ["its residuals are odd"],
        }
    }
}
FIGURES = {"count": 90, "rms": 0.015, "median": -0.001, "sigma_rms": 0.016,
           "within_1_sigma": 0.7, "within_2_sigma": 0.95}  # fmt: skip
CLOSURE = {"site": {"labels": FIGURES}, "images": {"A": {"labels": FIGURES}, "C": {}}}


def written(
    folder: Path, adjusted: dict, closure: dict, page: str | None, images: list = IMAGES
) -> Path:
    out = folder / "index.html"
    given = {"adjusted": adjusted, "closure": closure, "page": page, "index": None}
    write_site_page("City", images, PAIRS, out, **given)
    return out


def cells(text: str, section: str) -> list[list[str]]:
    part = re.search(rf'<section id="{section}">.*?</table>', text, re.DOTALL)[0]
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in part.split("<tr>")[2:]]


def test_residuals_and_closure_are_shown_as_they_are(tmp_path):
    text = written(tmp_path, ADJUSTED, CLOSURE, str(tmp_path / "report.html")).read_text()
    assert cells(text, "residuals") == [
        ["A", "4 of 5", "6.000", "0.250", "", "70", "0.110", "0.080", "0.020"]
    ]
    assert "A: its residuals are odd" in text
    (site, image) = cells(text, "closure")
    assert (site[0], image[0]) == ("all triplets", "A")
    assert site[1:5] == ["90", "−0.001", "0.015", "0.016"]
    assert text.count('<a href="report.html#scene-A-b"><use') == 1  # of the pair that is a scene
    assert '<a href="report.html#scene-A-b">A-b</a>' in text
    assert "&lt;b&gt;" in text and "<b>" not in text.partition("</header>")[2]
    assert cells(text, "images") == [
        ["A", "2024-01-02", "12.3", "150.0", "40.0"],
        ["&lt;b&gt;", "", "", "", ""],
    ]


def test_the_map_has_true_proportions(tmp_path):
    text = written(tmp_path, {}, {}, None).read_text()
    outlines = re.findall(r'<path d="([^"]*)" [^>]*/>\s*<title>(?:A|&lt;b&gt;)', text)
    first, second = (
        np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", path), float) for path in outlines
    )
    wide, high = np.ptp(first, axis=0)
    assert 1.27 < wide / high < 1.30  # 0.02 by 0.01 degrees at 50 degrees north
    assert second[0, 0] > first[0, 0]  # east is right
    assert first[0, 1] < first[2, 1]  # north is up


def test_sections_without_input_are_left_out(tmp_path):
    text = written(tmp_path, {}, {}, None).read_text()
    assert re.findall(r'<section id="(\w+)"', text) == ["map", "images", "pairs"]
    assert "in the table alone: 1." in text


def test_images_that_no_scene_uses_are_named(tmp_path):
    assert 'class="alarm"' not in written(tmp_path, {}, {}, None).read_text()
    images = [*IMAGES, replace(IMAGES[0], name="C")]
    text = written(tmp_path, {}, {}, None, images).read_text()
    assert "<li>1 image in no pair: C</li>" in text


@needs_chromium
def test_nothing_sticks_out_of_the_page(tmp_path):
    page = written(tmp_path, ADJUSTED, CLOSURE, None)
    script = "return document.documentElement.scrollWidth - innerWidth"
    seen = look(page, tmp_path, script, 390)
    assert seen.wrong == [] and seen.requests == [] and seen.found <= 0
