"""The page of a site, from pairs and records made by hand."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from stereocities.sites import drawn_site
from stereotruth.core.numerics.geometry import metres_per_degree
from stereotruth.core.products.rasters import write_tiff
from stereotruth.evaluate.report.site_page import write_site_page
from stereotruth.sensor.site_pairs import rate

from ....synthetic.site_sensors import exact_image

SITE = drawn_site(3, 11, images=3, side_px=160)
NAMES = "A", "<b>", "C"
A, B, C = (replace(exact_image(SITE, of), name=name) for name, of in zip(NAMES, SITE.images))
IMAGES = [A, B, replace(C, time=None, sun=None)]
PAIRS = rate(IMAGES)
SCENES = {"A-b": ("<b>", "A")}


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
    folder: Path, adjusted: dict, closure: dict, page: str | None, scenes: dict = SCENES
) -> Path:
    out = folder / "index.html"
    write_tiff(folder / "image.tif", np.arange(200 * 320).reshape(200, 320).astype(np.uint16))
    files = dict.fromkeys(NAMES, folder / "image.tif")
    given = {"adjusted": adjusted, "closure": closure, "page": page, "index": None}
    write_site_page("City", IMAGES, PAIRS, out, files=files, scenes=scenes, **given)
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
    (first, _, last) = cells(text, "images")
    assert first[1] == "A" and first[2] == f"{A.time:%Y-%m-%d %H:%M}"
    assert first[4:] == [f"{angle:.1f}" for angle in A.sun] and last[2:] != first[2:]
    assert last[2] == last[4] == ""
    data = base64.b64decode(re.search(r"base64,([^\"]*)", first[0])[1])
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (100, 160)
    assert picture[5, 80] < picture[50, 80] < picture[95, 80]
    pairs = {tuple(row[:2]): row for row in cells(text, "pairs")}
    assert len(pairs) == len(PAIRS) == 3
    for one in PAIRS:
        row = pairs[tuple(name.replace("<b>", "&lt;b&gt;") for name in one.names)]
        suns = "" if "C" in one.names else f"{one.pair.sun:.1f}"
        assert float(row[3]) == round(one.quality.bits, 1) and row[8] == suns, row


def test_the_map_has_true_proportions(tmp_path):
    text = written(tmp_path, {}, {}, None).read_text()
    path = re.search(r'<path d="([^"]*)" [^>]*/>\s*<title>A', text)[1]
    shown = np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", path), float)[:4] * [1, -1]
    col, row = np.array([[0, 159, 159, 0], [0, 0, 159, 159]], float)
    lon, lat = A.sensor.localize(col, row, float(A.sensor.rpc.height_off))
    metres = np.stack([lon, lat], axis=1) * metres_per_degree(float(lat.mean()))
    sides, drawn = (np.diff(ring, axis=0) for ring in (metres, shown))
    scale = np.linalg.norm(drawn) / np.linalg.norm(sides)
    np.testing.assert_allclose(drawn, sides * scale, atol=0.02 * np.abs(drawn).max())


def test_images_that_no_scene_uses_are_named(tmp_path):
    assert "<li>1 image in no pair: C</li>" in written(tmp_path, {}, {}, None).read_text()
    linked = written(tmp_path, {}, {}, None, SCENES | {"A-C": ("A", "C")}).read_text()
    assert 'class="alarm"' not in linked
