"""The page of a city: a hand-made city whose right images are the left ones, shifted."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereotruth.evaluate.report import page
from stereotruth.evaluate.report.page import CityFiles
from stereotruth.pages.page import PAPER

from ....browser import look, needs_chromium
from ....synthetic.reported_city import CITY, alignment, write_city

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def refinement(path: Path, applied: bool) -> Path:
    """The same alignment after a refinement that was applied, or not."""
    record = json.loads(alignment(path).read_text())
    for view in (record["left"], record["right"]):
        view["rms"] = {"before": 7.91, "after": 0.81}
    record["refinement"] = {
        "applied": applied,
        "reason": "" if applied else "the <points> agree",
        "used": 120,
        "sites": 17,
        "before": {"y_parallax": {"median": -0.0511, "rms": 0.11}},
        "after": {"y_parallax": {"median": -0.0021, "rms": 0.08 if applied else 0.11}},
    }
    path.write_text(json.dumps(record))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A page with everything that may be there, of 5 labelled tiles."""
    folder = tmp_path_factory.mktemp("city")
    sift = [0.3, 0.4, 0.5, 0.2, 0.1, ""]  # of tiles
    write_city(
        folder / "tiles",
        5,
        quality=["ok", "max_y_parallax_px;min_sift_matches", "ok", "ok", "ok", ""],
        sift_mean_absolute_error_px=sift,
        sift_matches=[10, 20, 30, 40, 50, ""],
    )
    scene = {"sift_matches": 150, "sift_mean_absolute_error_px": 0.2667, "quality": "ok"}
    export = json.loads((folder / "tiles/export.json").read_text())
    export |= {"quality": {"scenes": {"S-1": scene}}}
    (folder / "tiles/export.json").write_text(json.dumps(export))
    coverage = folder / "coverage.png"
    cv2.imwrite(str(coverage), np.full((60, 90, 3), 200, np.uint8))
    (folder / "truth.csv").write_text(
        "scope,labels,mean_absolute_px,share_of_hidden_labelled\n"
        "scene,1000,0.25,0.5\ntiles,900,0.125,\ntile T_0,90,0.0625,0.001\n"
    )
    deciles = [
        {"mean_uncertainty": s, "share_below_1": 0.7, "share_below_2": 1.0} for s in (0.1, 0.4)
    ]
    of_tiles = {
        "status": {"visible": {"labelled": 95, "low_correlation": 5}, "hidden": {}},
        "calibration": {"share_below_1": 0.7, "share_below_2": 0.96, "deciles": deciles},
    }
    (folder / "truth.json").write_text(
        json.dumps({"meaning": {"errors": "label less <truth>"}, "exported_tiles": of_tiles})
    )
    (folder / "table4.csv").write_text(
        "city,pair_number,matches_number,mean_errors_px,mean_absolute_errors_px,gross_share\n"
        "Ville (building),5,150,-0.01,0.30,0.001\n"
    )
    out = folder / "page" / "index.html"
    out.parent.mkdir()
    page.write_report(
        CITY,
        CityFiles(
            folder / "tiles",
            coverage=coverage,
            alignments={"S-1": alignment(folder / "alignment.json")},
            refinements={"S-1": refinement(folder / "refined.json", applied=True)},
            refinement_figures={"S-1": coverage, "S-2": folder / "none.png"},
            truth=folder / "truth.json",
            truth_table=folder / "truth.csv",
            table4=folder / "table4.csv",
        ),
        out,
        index=folder / "index.html",
        sliders=2,
        workers=2,
    )
    return out


def test_without_control_points_nothing_on_the_page_is_of_them(tmp_path):
    write_city(tmp_path / "tiles", 1)
    record = json.loads(alignment(tmp_path / "alignment.json").read_text())
    for view in (record["left"], record["right"]):
        view |= {"gcps": [], "rms": {}}
    (tmp_path / "alignment.json").write_text(json.dumps(record))
    figure = tmp_path / "figure.png"
    cv2.imwrite(str(figure), np.full((60, 90, 3), 200, np.uint8))
    files = CityFiles(
        tmp_path / "tiles",
        alignments={"S-1": tmp_path / "alignment.json"},
        refinements={"S-1": refinement(alignment(tmp_path / "refined.json"), applied=True)},
        residual_figures={"S-1": figure},
        refinement_figures={"S-1": figure},
    )
    page.write_report(CITY, files, tmp_path / "index.html", sliders=0)
    text = (tmp_path / "index.html").read_text()
    section = re.search(r'<section id="alignment">.*?</section>', text, re.DOTALL)[0]
    assert "120 tie points" in section and section.count("<img") == 1
    assert "GCP residuals" not in text and "Ground control points<" not in text


@pytest.mark.slow
def test_a_page_keeps_within_its_bytes_however_many_tiles(tmp_path, monkeypatch):
    write_city(tmp_path / "tiles", 12)
    monkeypatch.setattr(page, "PICTURE_BYTES", 200_000)
    sizes = []
    for sliders in (0, 4, 12):
        page.write_report(
            CITY, CityFiles(tmp_path / "tiles"), tmp_path / "index.html", sliders=sliders
        )
        text = (tmp_path / "index.html").read_text()
        embedded = re.findall(r'src="data:([^"]*)"', text)
        sizes.append(sum(map(len, embedded)))
        assert len(re.findall('class="stack"', text)) == sliders
        assert len(re.findall('<article class="tile"', text)) == 13
    assert 30_000 < sizes[0] < sizes[1] <= 200_000
    assert sizes[2] <= 200_000


def test_nothing_on_the_page_asks_for_a_file_or_the_network(made):
    text = made.read_text()
    sources = re.findall(r"""(?:src|href|srcset|data|action)\s*=\s*["']([^"']*)""", text)
    assert sources
    links = re.findall(r'<a (?:class="[^"]*" )?href="([^"#][^"]*)"', text)  # asked for by a click
    others = [s for s in sources if s not in links]
    assert all(s.startswith(("data:image/webp;base64,", "#")) for s in others)
    here = [link for link in links if link != PAPER and not link.startswith("data:text/csv")]
    assert here and all((made.parent / link).exists() for link in here if link != "../index.html")
    assert not re.search(r"url\((?!#)|@import|<link|fetch\(|XMLHttp", text)
    assert set(re.findall(r"https?://[^\"<]*", text)) == {PAPER}


def test_a_missed_gate_is_red_and_named(made):
    text = made.read_text()
    alarm = re.search(r'<div class="alarm" role="note">(.*?)</div>', text, re.DOTALL)[1]
    assert re.findall(r'href="#tile-(\w+)"', alarm) == ["T_1"]
    assert "y-parallax too high, SIFT matches too low" in alarm
    assert 'class="bad">max_y_parallax_px;min_sift_matches</td>' in text
    assert "1 of 5 tiles miss one" in text


def test_headlines_and_tables_say_what_the_files_say(made):
    text = made.read_text()
    heads = dict(re.findall(r'<dt>(.*?)</dt><dd class="value">(.*?)</dd>', text))
    assert heads["labelled pairs"] == "5"
    assert "1 more without full labels" in text
    assert heads["GCP residuals, rms"] == "0.79 px"
    assert heads["SIFT disparity − label"] == "0.27 px"  # of the scene, not the mean of tiles
    assert heads["error against the truth"] == "0.125 px"  # of the tiles, not the whole scene
    assert "hidden pixels labelled" not in heads  # empty for the tiles
    status = re.search(r"What became of the pixels.*?</table>", text, re.DOTALL)[0]
    assert re.findall(r"<td[^>]*>(.*?)</td>", status) == ["visible", "100", "95.00 %", "5.00 %"]
    table4 = re.search(r'<section id="sift">.*?</section>', text, re.DOTALL)[0]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in table4.split("<tr>")[2:]]
    assert rows[0] == ["Ville (building)", "5", "150", "−0.010", "0.300", "0.10 %"]
    assert ["Qichun (vegetation)", "736", "99457", "−0.500", "0.790", ""] in rows
    assert len(rows) == 11


def test_a_refinement_is_shown_with_before_and_after(tmp_path):
    write_city(tmp_path / "tiles", 1)
    page.write_report(
        "City",
        CityFiles(
            tmp_path / "tiles",
            alignments={"S-1": alignment(tmp_path / "a.json")},
            refinements={"S-1": refinement(tmp_path / "r.json", applied=False)},
        ),
        tmp_path / "index.html",
    )
    text = (tmp_path / "index.html").read_text()
    said = "<b>not applied</b>, since the &lt;points&gt; agree."
    assert f"{said} 120 tie points at 17 sites." in text
    table = re.search(r"Tie points <button.*?</table>", text, re.DOTALL)[0]
    assert re.findall(r"<td[^>]*>(.*?)</td>", table) == [
        *("y-parallax before", "−0.051", "0.110"),
        *("y-parallax after", "−0.002", "0.110"),
    ]


def test_scenes_and_limits_of_the_gates_are_listed(tmp_path):
    write_city(tmp_path / "tiles", 1, quality=["ok", ""])
    miss = "max_y_parallax_px"
    record = {
        "limits": {"max_y_parallax_px": 0.5, "min_sift_matches": 10, "max_gcp_rms_px": None},
        "scenes": {
            "S-1": {
                "y_parallax_median_px": 0.7,
                "gcp_rms_px": None,
                "quality": "max_y_parallax_px",
            },
            "S-2": {"y_parallax_median_px": 0.1, "gcp_rms_px": 0.3, "quality": "ok"},
        },
    }
    (tmp_path / "tiles/export.json").write_text(json.dumps({"quality": record}))
    page.write_report("City", CityFiles(tmp_path / "tiles"), tmp_path / "index.html", sliders=2)
    text = (tmp_path / "index.html").read_text()
    section = re.search(r'<section id="quality">.*?</section>', text, re.DOTALL)[0]
    assert "Limits: y-parallax ≤ 0.5 px; SIFT matches ≥ 10." in section
    assert re.findall(r"<td[^>]*>(.*?)</td>", section) == [
        *("S-1", miss, "0.700", ""),
        *("S-2", "ok", "0.100", "0.300"),
    ]
    assert re.findall(r'class="bad">(.*?)<', section) == [miss]
    assert "and S-1 as a whole" in text


def test_a_real_city_without_truth_or_evaluation_has_no_empty_sections(tmp_path):
    write_city(tmp_path / "tiles", 2)
    page.write_report(
        "Bare",
        CityFiles(tmp_path / "tiles", truth="none", truth_table="none"),
        tmp_path / "index.html",
        sliders=2,
    )
    text = (tmp_path / "index.html").read_text()
    sections = re.findall(r'<section id="(\w+)"', text)
    assert sections == ["large", "tiles", "disparities", "manifest", "provenance"]
    assert re.findall(r'<li><a href="#([a-z]+)">', text) == sections
    assert "exact truth" not in text.lower()
    assert "limits of quality" not in text.lower()


# ------------------------------------------------------------------------------ in a browser

CHECKS = """
const stack = document.querySelector(".stack"), range = stack.querySelector("input");
const over = stack.querySelector(".over"), clip = [];
for (const value of [50, 20, 80]) {
  range.value = value;
  range.dispatchEvent(new Event("input", { bubbles: true }));
  clip.push(getComputedStyle(over).clipPath);
}
range.focus();
const focused = document.activeElement === range;
const layers = () => [...stack.querySelectorAll("img")].filter((i) => i.offsetParent).map(
  (i) => i.dataset.name);
const before = layers(), right = stack.parentElement.querySelector("[data-side=right]");
right.value = "disparity";
right.dispatchEvent(new Event("change"));
const corners = [...stack.querySelectorAll(".corner")].map((c) => c.textContent);
const scales = [...stack.parentElement.querySelectorAll(".key")].filter((k) => k.offsetParent).map(
  (k) => k.dataset.name);
const table = document.querySelector("#manifest table");
const head = [...table.tHead.rows[0].cells].find((c) => c.textContent === "disparity mean, px");
const sorted = [], tiles = () => [...table.tBodies[0].rows].map((r) => r.cells[0].textContent);
for (const turn of [1, 2]) {
  head.querySelector("button").click();
  sorted.push([head.getAttribute("aria-sort"), tiles()]);
}
location.hash = "#tile-T_4";
dispatchEvent(new HashChangeEvent("hashchange"));
return {
  images: [...document.images].map((i) => [i.alt, i.naturalWidth]),
  clip, focused, corners, scales, layers: [before, layers()], sorted,
  opened: document.querySelector("#tile-T_4 details").open,
  wide: document.documentElement.scrollWidth - innerWidth, width: innerWidth,
  broken: "broken" in window, title: document.title,
};
"""


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_works_in_a_browser_without_a_network(made, tmp_path, width):
    seen = look(made, tmp_path, CHECKS, width)
    assert seen.wrong == []
    assert seen.requests == []
    found = seen.found
    assert found["width"] == width
    assert found["wide"] <= 0  # nothing sticks out sideways
    assert not found["broken"] and found["title"].startswith(CITY)
    # 4 pictures of 5 tiles, 5 large ones of 2, 2 of the pair without labels, map, tie points
    assert len(found["images"]) == 20 + 10 + 2 + 2
    assert found["corners"] == ["left", "disparity"] and found["scales"] == ["disparity"]
    assert all(alt and size > 0 for alt, size in found["images"])
    assert [re.search(r"([\d.]+)%", text)[1] for text in found["clip"]] == ["50", "80", "20"]
    assert found["focused"]
    assert found["layers"] == [["left", "warped right"], ["left", "disparity"]]
    means = {f"T_{k}": (13 * k) % 10 for k in range(6)}
    upwards = sorted(means, key=means.__getitem__)
    assert found["sorted"] == [["ascending", upwards], ["descending", upwards[::-1]]]
    assert found["opened"]


def test_what_cannot_have_changed_is_named_so():
    row = {"count_changed": "9", "count_labelled": "1", "count_masked": ""}
    assert page.status_counts(row) == {page.MISFIT: 9, "labelled": 1}
    assert page.status_counts(row | {"lidar_days_left": "300"}) == {"changed": 9, "labelled": 1}
