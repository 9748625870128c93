"""The page of a city: a hand-made city whose right images are the left ones, shifted."""

from __future__ import annotations

import base64
import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.products import html_tables, pictures
from stereotruth.products.rasters import write_tiff
from stereotruth.report import drawings, page, tile_pictures

from ..browser import look, needs_chromium, screenshot

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIZE = 96
SHIFT = 7  # px of disparity, of every tile
HOLE = np.s_[10:30, 20:50]  # pixels without a label
FLAGS = {0: "no_points", 1: "labelled", 2: "hidden_in_left", 9: "a_new_reason"}
CITY = 'Ville <b>"A & B"</b>'
REASON = "<script>window.broken = true</script> 9.1 px off"


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(SIZE, SIZE + 2 * SHIFT)).astype(np.float32)
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 2.5) * 900 + 600, 1, 2000).astype(np.uint16)


def row_of(name: str, number: int, **values: object) -> dict[str, object]:
    row = {
        "tile": name,
        "number": number,
        "city": CITY,
        "scene": f"S-{1 + number % 2}",
        "row0": SIZE * (number // 2),
        "col0": 0,
        "size": SIZE,
        "right_offset_px": -3,
        "complete": "yes",
        "split": ("train", "test", "val")[number % 3],
        "labelled_share": f"{1 - 600 / SIZE**2:.6f}",
        "disparity_min_px": f"{SHIFT:.4f}",
        "disparity_mean_px": f"{(13 * number) % 10 + 0.5:.4f}",
        "disparity_max_px": f"{SHIFT:.4f}",
        "count_no_points": 0,
        "count_labelled": SIZE**2 - 600,
        "count_hidden_in_left": 0,
        "count_a_new_reason": 600,
        "left": f"left/{name}.tiff",
        "right": f"right/{name}.tiff",
        "disp": f"disp/{name}.tiff",
        "status": f"status/{name}.tiff",
        "left_sha256": "0" * 64,
    }
    return row | values


def write_city(folder: Path, count: int, **columns: list[object]) -> list[dict[str, object]]:
    """tiles/<City> of ``count`` labelled tiles and one without labels; ``columns`` by tile."""
    rows = []
    for kind in ("left", "right", "disp", "status"):
        (folder / kind).mkdir(parents=True)
    for k in range(count + 1):
        name = f"T_{k}"
        row = row_of(name, k, **{key: values[k] for key, values in columns.items()})
        whole = texture(k)
        write_tiff(folder / row["left"], whole[:, SHIFT:-SHIFT], nodata=0)
        write_tiff(folder / row["right"], whole[:, 2 * SHIFT :], nodata=0)
        disparity = np.full((SIZE, SIZE), SHIFT, np.float32)
        disparity[HOLE] = -999
        status = np.where(disparity == -999, 9, 1).astype(np.uint8)
        if k < count:
            write_tiff(folder / row["disp"], disparity, nodata=-999)
            text = ", ".join(f"{value} {name}" for value, name in FLAGS.items())
            write_tiff(folder / row["status"], status, description=text)
        else:
            row |= {"complete": "no", "split": "none", "disp": "", "status": ""}
        rows.append(row)
    with (folder / "manifest.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (folder / "export.json").write_text(
        json.dumps({"size_px": SIZE, "provenance": {"code": "<i>c0de</i>", "inputs": {"x": "y"}}})
    )
    return rows


def alignment(path: Path) -> Path:
    """Two GCPs off by (3, 4) and (−6, 8) px before, a tenth of it after; a third left out."""
    gcps = [
        {"id": "G1", "measured": [100.0, 50.0], "before": [3.0, 4.0], "used": True, "reason": ""},
        {"id": "G2", "measured": [10.0, 180.0], "before": [-6.0, 8.0], "used": True, "reason": ""},
        {"id": "G3", "measured": [150.0, 90.0], "before": [90.0, 0.0], "used": False,
         "reason": REASON},
    ]  # fmt: skip
    for gcp in gcps:
        gcp["after"] = [v / 10 for v in gcp["before"]]
        gcp["leave_one_out"] = [None, None]
    view = {"size": [200, 200], "gcps": gcps, "rms": {"before": 7.91, "after": 0.79}}
    record = {"model": "shift", "left": view, "right": view, "warnings": [f"left image: {REASON}"]}
    path.write_text(json.dumps(record))
    return path


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
    sift = [0.3, 0.4, 0.5, 0.2, 0.1, ""]
    write_city(
        folder / "tiles",
        5,
        quality=["ok", "max_y_parallax_px;min_sift_matches", "ok", "ok", "ok", ""],
        sift_mean_absolute_error_px=sift,
        sift_matches=[10, 20, 30, 40, 50, ""],
    )
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
        folder / "tiles",
        out,
        coverage=coverage,
        alignments={"S-1": alignment(folder / "alignment.json")},
        refinements={"S-1": refinement(folder / "refined.json", applied=True)},
        refinement_figures={"S-1": coverage, "S-2": folder / "none.png"},
        truth=folder / "truth.json",
        truth_table=folder / "truth.csv",
        table4=folder / "table4.csv",
        sliders=2,
        workers=2,
    )
    return out


def picture(uri: str) -> np.ndarray:
    data = base64.b64decode(uri.removeprefix("data:image/webp;base64,"))
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def test_the_right_image_warps_onto_the_left_and_leaves_no_difference(tmp_path):
    rows = write_city(tmp_path, 1)
    made = tile_pictures.tile_pictures(
        tmp_path, rows[0], thumbnail=(SIZE, 10**6), slider=(SIZE, 10**6)
    )
    assert made.histogram == {SHIFT: SIZE**2 - 600}
    assert made.disparity_px == (SHIFT, SHIFT)
    assert made.correlation == pytest.approx(1.0)
    left, warped = picture(made.uris["slider_left"]), picture(made.uris["slider_warped"])
    inner = np.s_[40:, 2 * SHIFT : -SHIFT]
    assert np.abs(left - warped)[inner].mean() < 3  # grey values: compression
    assert left[inner].std() > 20
    difference = picture(made.uris["slider_difference"])
    assert difference[inner].min() > 235
    assert np.abs(warped[15:25, 26:44] - tile_pictures.NO_MATCH).max() < 25
    assert np.abs(difference[15:25, 26:44] - tile_pictures.NO_DIFFERENCE).max() < 25
    status = picture(made.uris["status"])
    colours = tile_pictures.status_colours(list(FLAGS.values()))
    for place, name in ((status[60:, 60:], "labelled"), (status[15:25, 26:44], "a_new_reason")):
        assert np.abs(place - tuple(bytes.fromhex(colours[name][1:]))).max() < 25


def test_a_wrong_disparity_shows_in_the_difference(tmp_path):
    rows = write_city(tmp_path, 1)
    write_tiff(tmp_path / rows[0]["disp"], np.full((SIZE, SIZE), 4, np.float32), nodata=-999)
    made = tile_pictures.tile_pictures(
        tmp_path, rows[0], thumbnail=(9, 10**6), slider=(SIZE, 10**6)
    )
    assert made.correlation < 0.9
    assert picture(made.uris["slider_difference"])[40:, 20:80].min(axis=2).mean() < 150


@pytest.mark.parametrize("limit", [200, 2000, 20_000, 10**6])
def test_pictures_keep_within_their_bytes(limit):
    noise = np.random.default_rng(0).integers(0, 255, (300, 200, 3)).astype(np.uint8)
    for image in (noise, noise[..., 0]):
        data = base64.b64decode(pictures.encode(image, limit).partition(",")[2])
        assert len(data) <= limit
    shape = picture(pictures.encode(noise, limit)).shape
    assert shape[0] / shape[1] == pytest.approx(1.5, rel=0.2)
    assert (shape == noise.shape) == (limit == 10**6)


def test_a_page_keeps_within_its_bytes_however_many_tiles(tmp_path, monkeypatch):
    write_city(tmp_path / "tiles", 12)
    monkeypatch.setattr(page, "PICTURE_BYTES", 200_000)
    sizes = []
    for sliders in (0, 4, 12):
        page.write_report(CITY, tmp_path / "tiles", tmp_path / "index.html", sliders=sliders)
        text = (tmp_path / "index.html").read_text()
        sizes.append(sum(map(len, re.findall(r'src="(data:[^"]*)"', text))))
        assert len(re.findall('class="stack"', text)) == sliders
        assert len(re.findall('class="quads"', text)) == 12
    assert 30_000 < sizes[0] < sizes[1] <= 200_000
    assert sizes[2] <= 200_000


def test_the_page_is_the_same_again_with_any_workers(made, tmp_path):
    city = made.parents[1]
    write = dict(coverage=city / "coverage.png", sliders=2)
    texts = []
    for workers in (1, 3):
        page.write_report(CITY, city / "tiles", tmp_path / "p.html", workers=workers, **write)
        texts.append((tmp_path / "p.html").read_bytes())
    assert texts[0] == texts[1]


def test_nothing_on_the_page_asks_for_a_file_or_the_network(made):
    text = made.read_text()
    sources = re.findall(r"""(?:src|href|srcset|data|action)\s*=\s*["']([^"']*)""", text)
    assert sources
    assert all(s.startswith(("data:image/webp;base64,", "#")) for s in sources)
    assert not re.search(r"https?://|url\((?!#)|@import|<link|fetch\(|XMLHttp", text)


def test_text_is_escaped(made):
    text = made.read_text()
    assert "<h1>Ville &lt;b&gt;" in text
    assert REASON not in text
    assert text.count("&lt;script&gt;window.broken") >= 3
    assert "label less &lt;truth&gt;" in text
    assert "&lt;i&gt;c0de&lt;/i&gt;" in text


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
    assert heads["pairs without full labels"] == "1"
    assert heads["GCP residuals, rms"] == "0.79 px"
    assert heads["SIFT, mean absolute error"] == "0.30 px"  # of 0.3, 0.4, 0.5, 0.2, 0.1
    assert heads["error against the truth"] == "0.125 px"  # of the tiles, not the whole scene
    assert "hidden pixels labelled" not in heads  # empty for the tiles
    status = re.search(r"What became of the pixels.*?</table>", text, re.DOTALL)[0]
    assert re.findall(r"<td[^>]*>(.*?)</td>", status) == ["visible", "100", "95.00 %", "5.00 %"]
    table4 = re.search(r'<section id="sift">.*?</section>', text, re.DOTALL)[0]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in table4.split("<tr>")[2:]]
    assert rows[0] == ["Ville (building)", "5", "150", "−0.010", "0.300", "0.10 %"]
    assert ["Qichun (vegetation)", "736", "99457", "−0.500", "0.790", ""] in rows
    assert len(rows) == 11


@pytest.mark.parametrize("applied", [True, False])
def test_a_refinement_is_shown_with_before_and_after(tmp_path, applied):
    write_city(tmp_path / "tiles", 1)
    page.write_report(
        "City",
        tmp_path / "tiles",
        tmp_path / "index.html",
        alignments={"S-1": alignment(tmp_path / "a.json")},
        refinements={"S-1": refinement(tmp_path / "r.json", applied)},
    )
    text = (tmp_path / "index.html").read_text()
    frames = re.findall(r"<figcaption>(.*? image, .*?)</figcaption>", text)
    after = ["left image, after refinement: 0.81 px rms"] if applied else []
    assert frames[: len(frames) // 2] == [
        "left image, RPC alone: 7.91 px rms",
        "left image, after the fit: 0.79 px rms",
        *after,
    ]
    said = "<b>applied</b>." if applied else "<b>not applied</b>, since the &lt;points&gt; agree."
    assert f"{said} 120 tie points at 17 sites." in text
    table = re.search(r"Tie points</caption>.*?</table>", text, re.DOTALL)[0]
    assert re.findall(r"<td[^>]*>(.*?)</td>", table) == [
        *("y-parallax before", "−0.051", "0.110"),
        *("y-parallax after", "−0.002", "0.080" if applied else "0.110"),
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
    page.write_report("City", tmp_path / "tiles", tmp_path / "index.html")
    text = (tmp_path / "index.html").read_text()
    section = re.search(r'<section id="quality">.*?</section>', text, re.DOTALL)[0]
    assert "Limits: y-parallax ≤ 0.5 px; SIFT matches ≥ 10." in section
    assert re.findall(r"<td[^>]*>(.*?)</td>", section) == [
        *("S-1", miss, "0.700", ""),
        *("S-2", "ok", "0.100", "0.300"),
    ]
    assert re.findall(r'class="bad">(.*?)<', section) == [miss]
    assert "and S-1 as a whole" in text


def test_calibrated_groups_lie_on_the_lines():
    deciles = [
        {"mean_uncertainty": sigma, "share_below_1": once, "share_below_2": twice}
        for sigma, once, twice in ((0.1, 0.683, 0.954), (0.3, 0.25, 1.0))
    ]
    drawn = drawings.calibration(deciles)
    right, wrong = drawn.groups
    assert [y for y, _ in drawn.right] == pytest.approx([right[1], right[2]], abs=0.11)
    assert wrong[:3] == (0.75 * drawings.WIDTH, 0.75 * drawings.HEIGHT, 0.0)
    assert (right[3], wrong[3]) == ("0.100", "0.300")
    assert drawings.calibration([]) is None


def test_a_real_city_without_truth_or_evaluation_has_no_empty_sections(tmp_path):
    write_city(tmp_path / "tiles", 2)
    page.write_report(
        "Bare", tmp_path / "tiles", tmp_path / "index.html", truth="none", truth_table="none"
    )
    text = (tmp_path / "index.html").read_text()
    sections = re.findall(r'<section id="(\w+)"', text)
    assert sections == ["map", "disparities", "tiles", "manifest", "provenance"]
    assert re.findall(r'<li><a href="#([a-z]+)">', text) == sections
    assert "exact truth" not in text.lower()
    assert "quality gates" not in text.lower()


def test_without_a_manifest_it_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match="no manifest"):
        page.write_report("None", tmp_path, tmp_path / "index.html")


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
    assert first.count == 40 and second.count == 80
    assert first.mean == pytest.approx((0.5 * 10 + 5.5 * 30) / 40)
    assert first.ticks == second.ticks
    bar = drawings.WIDTH / 50  # px of two: −40 … 60
    heights = [float(y) for y in re.findall(r"V([\d.]+)H", first.path)]
    assert len(heights) == 50
    assert heights[20] == pytest.approx(drawings.HEIGHT * (1 - 10 / 30), abs=0.1)
    assert heights[22] == 0
    assert re.findall(r"H([\d.]+)", first.path)[0] == f"{bar:.1f}"


@pytest.mark.parametrize(
    ("name", "text", "shown"),
    [
        ("labelled_share", "0.123456", "12.35 %"),
        ("mean_px", "-0.1", "−0.100"),
        ("mean_px", "-0.0001", "0.000"),
        ("labelled_share", "-0.00001", "0.00 %"),
        ("row0", "1024", "1024"),
        ("labels", "5061336", "5 061 336"),
        ("class", "building", "building"),
        ("lon", "114.30004567", "114.30005"),
        ("rms", "nan", "nan"),
        ("rms", "", ""),
    ],
)
def test_values_are_shown_as_people_read_them(name, text, shown):
    assert html_tables.show(name, text) == shown


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
const under = [...stack.querySelectorAll(".under")];
const layers = () => under.filter((i) => i.offsetParent).map((i) => i.dataset.layer);
const before = layers();
stack.parentElement.querySelector("[value=disparity]").click();
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
  clip, focused, layers: [before, layers()], sorted,
  opened: document.querySelector("#tile-T_4 details").open,
  wide: document.documentElement.scrollWidth - innerWidth, width: innerWidth,
  broken: "broken" in window, title: document.title,
};
"""


@needs_chromium
@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_works_in_a_browser_without_a_network(made, tmp_path, width):
    seen = look(made, tmp_path, CHECKS, width)
    assert seen.wrong == []
    assert seen.requests == []
    found = seen.found
    assert found["width"] == width
    assert found["wide"] <= 0  # nothing sticks out sideways
    assert not found["broken"] and found["title"].startswith(CITY)
    # 4 pictures of 5 tiles, 4 large ones of 2, 2 of the pair without labels, map, tie points
    assert len(found["images"]) == 20 + 8 + 2 + 2
    assert all(alt and size > 0 for alt, size in found["images"])
    assert [re.search(r"([\d.]+)%", text)[1] for text in found["clip"]] == ["50", "80", "20"]
    assert found["focused"]
    assert found["layers"] == [["warped"], ["disparity"]]
    means = {f"T_{k}": (13 * k) % 10 for k in range(6)}
    upwards = sorted(means, key=means.__getitem__)
    assert found["sorted"] == [["ascending", upwards], ["descending", upwards[::-1]]]
    assert found["opened"]


@needs_chromium
def test_the_browser_would_tell_of_a_request_and_an_error(made, tmp_path):
    spoilt = tmp_path / "spoilt.html"
    text = made.read_text()
    spoilt.write_text(
        text.replace("<main>", '<main><img src="http://example.invalid/a.png" alt="x">').replace(
            "</main>", "</main><script>nothing.at.all;</script>"
        )
    )
    seen = look(spoilt, tmp_path, "return 1")
    assert any("example.invalid" in text for text in seen.wrong)
    assert any("nothing is not defined" in text for text in seen.wrong)


@needs_chromium
def test_screenshots_show_something(made, tmp_path):
    for width in (1280, 500):
        shot = screenshot(made, tmp_path / f"{width}.png", width, 1600)
        image = cv2.imread(str(shot))
        assert image.shape[:2] == (1600, width)
        assert image.std() > 15
