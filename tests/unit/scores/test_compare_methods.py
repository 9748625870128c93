"""From predictions to scores, tables, pictures and the page: its numbers are those of the files."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from stereobench.scores import panels
from stereobench.scores.compare_methods import (
    beside_published,
    confidence_chart,
    confidence_table,
    cumulative_chart,
    read_curves,
    strata_chart,
)
from stereobench.scores.confidence import Confidence
from stereobench.scores.panels import Column, draw_columns, error_picture
from stereotruth.core.products.files import write_table

from ...browser import look, needs_chromium
from ...synthetic.toy_benchmark import texts

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@needs_chromium
def test_the_page_is_whole_and_needs_no_network(compared, tmp_path):
    seen = look(
        compared / "compared/index.html",
        tmp_path,
        "const dead = [...document.querySelectorAll('a[href^=\"#\"]')].filter("
        "(a) => !document.getElementById(a.getAttribute('href').slice(1))).length;"
        "return [dead, document.images.length,"
        " [...document.images].every((i) => i.naturalWidth > 0),"
        " document.querySelectorAll('table').length, document.body.innerText]",
    )
    assert seen.wrong == [] and seen.requests == []
    dead, count, loaded, tables, text = seen.found
    assert dead == 0
    assert count == 5 + 6 + 2 and loaded and tables == 6
    for word in ("Accuracy, time and memory", "table 5 of the paper", "Half", "Kunming", "EPE"):
        assert word in text


@pytest.fixture(scope="module")
def text(compared) -> str:
    return (compared / "compared/index.html").read_text()


@pytest.fixture(scope="module")
def scores(compared) -> dict[str, dict]:
    return {
        name: json.loads((compared / f"benchmark/{name}/scores.json").read_text())
        for name in ("two", "half")
    }


def cells(text: str, section: str) -> list[list[str]]:
    """Cells of the section's first table, by rows; those of the best as ``*text*``."""
    part = re.search(rf'<section id="{section}">.*?</table>', text, re.DOTALL)[0]
    part = re.sub(
        r'<td class="[^"]*best[^"]*"[^>]*>(.*?)</td>', r"<td>*\1*</td>", part, flags=re.DOTALL
    )
    return [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in part.split("<tr>")[2:]]


def test_the_best_is_bold_and_has_its_interval(text, scores):
    two, half = cells(text, "methods")
    row = scores["half"]["all"]
    ends = f"[{row['filled_epe_px_low']:.3f}, {row['filled_epe_px_high']:.3f}]"
    best, worse = sorted(
        (two, half), key=lambda line: float(re.search(r"[\d.]+", line[1])[0])
    )  # holes are filled from the neighbours, of noise: Half is the worse
    expected = {name: f"{of['all']['filled_epe_px']:.3f}" for name, of in scores.items()}
    assert best[1].startswith(f"*{min(expected.values())}") and best[1].endswith("]*")
    assert worse[1].startswith(max(expected.values()))
    assert half[0] == "Half" and ends in half[1]
    # of the valid pixels alone Half is 0.5 px off, Two 2 px; and Two is valid everywhere
    for error in (4, 5):  # median, mean
        assert [line[error][:6] for line in (two, half)] == ["2.000", "*0.500"]
    assert [line[7][:7] for line in (two, half)] == ["*100.00", "75.00"]


def test_the_page_opens_with_the_ranking(text, scores):
    assert re.search(r'<section id="(\w+)"', text)[1] == "ranking"
    (protocol,) = re.findall(r"Protocol of all scores: <code>(own-\w+)</code>", text)
    assert text.count(protocol) == 1
    lines = cells(text, "ranking")
    by_epe = sorted(scores.values(), key=lambda of: of["all"]["filled_epe_px"])
    assert [line[0] for line in lines] == [of["label"] for of in by_epe]
    for line, of in zip(lines, by_epe):
        row = of["all"]
        ends = [row[f"filled_epe_px_{end}"] for end in ("low", "high")]
        assert "data:image/webp" in line[1]
        expected = f"{row['filled_epe_px']:.3f}\n[{ends[0]:.3f}, {ends[1]:.3f}]"
        assert line[2].strip("*") == expected
        for cell, limit in zip(line[3:], ("3", "1")):
            share = 100 * row[f"filled_d1_{limit}_px_share"]
            assert cell.strip("*").startswith(f"{share:.2f}\n[")


def summary(label, factor, count=20_000):
    """Normal errors of 1 px, and uncertainties ``factor`` times too small."""
    found = Confidence()
    rng = np.random.default_rng(4)
    sigma = rng.uniform(0.2, 2, count)
    found.add(rng.normal(0, sigma), sigma / factor, np.zeros(count))
    empty = {"stratum": "exact_hidden", "pixels": 0}
    return {
        "label": label,
        "confidence": [{"stratum": "all", **found.figures()}, empty],
    }, found


def test_the_table_has_methods_by_stratum():
    methods = [summary("Calibrated", 1)[0], summary("Too sure", 3)[0]]
    methods.append({"label": "Silent", "confidence": []})
    table = confidence_table(methods)
    assert [(row["method"], row["stratum"]) for row in table.rows] == [
        ("Calibrated", "all"),
        ("Too sure", "all"),
    ]
    ((_, shown),) = table.shown
    lines = texts(shown)
    assert len(shown.columns) == len(lines[0]) and lines[1][0] == "Too sure, all"
    assert float(lines[0][5]) == pytest.approx(68.27, abs=1)
    assert float(lines[0][-1]) == pytest.approx(1, abs=0.03)
    assert float(lines[1][-1]) == pytest.approx(3, abs=0.1)
    # the order is the same, the sizes are not
    assert lines[0][3] == lines[1][3] and float(lines[1][5]) < 40


def test_errors_have_one_scale_and_holes_a_colour():
    truth = np.array([[0, 0, 0, np.nan]], np.float32)
    found = np.array([[0, 6, np.nan, 1]], np.float32)
    none, full, hole, unlabelled = error_picture(found, truth)[0].tolist()
    assert sum(none) < 20 and sum(full) > 600
    assert tuple(hole) == panels.INVALID
    assert tuple(unlabelled) == panels.NO_VALUE


def test_names_are_no_formulas(tmp_path):
    """Of pairs and of methods; Matplotlib would end with an error."""
    name = "$a_{"
    image = np.arange(64, dtype=np.uint16).reshape(8, 8)
    flat = np.full((8, 8), 3.0, np.float32)
    for across in (False, True):
        column = Column(name, image, image, flat, {name: flat})
        draw_columns(tmp_path / "a.png", [column], across=across)
        assert cv2.imread(str(tmp_path / "a.png")) is not None


def test_published_rows_say_where_they_stand_and_what_is_not_known():
    own = {
        "label": "Mine",
        "tiles": 4,
        "protocol": {"name": "whu-2023", "id": "whu-2023-12345678"},
        "all": {"filled_epe_px": 1.5, "filled_d1_3_px_share": 0.125, "labelled": 9},
    }
    table = beside_published([own])
    assert table.rows[0]["d1_percent"] == 12.5 and table.rows[0]["source"] == "here, 4 pairs"
    by_name = {row["method"]: row for row in table.rows}
    assert by_name["HMSM-Net"]["epe_px"] == 1.672 and by_name["SGM"]["d1_percent"] == 50.79
    assert by_name["TGRNet"]["epe_px"] == 1.586
    assert all(row["source"] and row["not_known"] for row in table.rows[1:])
    assert "whu-2023-12345678" in table.shown[0][0]
    nothing = beside_published([own | {"protocol": {"name": "own", "id": "own-1"}}])
    assert nothing.rows == [] and "Nothing is published" in nothing.shown[0][0]


def test_the_curves_are_drawn(tmp_path):
    one, found = summary("Calibrated", 1)
    curves = [
        {"stratum": "all", "removed_share": k / 100, "epe_px": a, "oracle_epe_px": b}
        for k, (a, b) in enumerate(zip(*found.curves()))
    ]
    write_table(tmp_path / "sparsification.csv", curves)
    (share, stated, oracle) = read_curves(tmp_path)["all"]
    assert share == pytest.approx(np.arange(100)) and len(stated) == 100
    assert stated == pytest.approx(found.curves()[0]) and oracle == pytest.approx(found.curves()[1])
    chart = confidence_chart([one], [tmp_path])
    assert re.findall("<title>(.*?)</title>", chart.svg) == ["Calibrated"]
    assert confidence_chart([{"label": "Silent", "confidence": []}], [tmp_path]) is None


def test_charts_have_a_line_and_a_point_where_the_files_say(compared):
    folders = [compared / "benchmark" / name for name in ("two", "half")]
    methods = [json.loads((folder / "scores.json").read_text()) for folder in folders]
    lines = re.findall(r"<title>(.*?)</title>", cumulative_chart(methods, folders).svg)
    assert lines == ["Two", "Half"]
    said = re.findall(r"<title>(.*?)</title>", strata_chart(methods).svg)
    assert len(said) == sum(len(of["strata"]) for of in methods)
    for of in methods:
        for row in of["strata"]:
            name = f"{of['label']}, {row['stratum'].replace('_', ' ')}"
            assert any(f"{name}: {row['filled_epe_px']:.3f}" in text for text in said)
