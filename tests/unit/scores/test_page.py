"""The page of a benchmark: its numbers are those of the JSON and CSV files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from stereobench.scores.page import cumulative_chart, ranking, strata_chart
from stereobench.scores.tables import read_scores

from ...browser import look, needs_chromium
from ...synthetic.toy_benchmark import rows

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


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


def test_by_what_pixels_show_the_best_of_each_row_is_bold(text, scores):
    by_stratum = {
        name: {row["stratum"]: row["filled_epe_px"] for row in of["strata"]}
        for name, of in scores.items()
    }
    lines = cells(text, "strata")
    assert len(lines) == len(by_stratum["two"])
    for stratum, two, _, half, _ in lines:
        values = {name: of[stratum.replace(" ", "_")] for name, of in by_stratum.items()}
        for name, cell in (("two", two), ("half", half)):
            assert cell.strip("*").split(" ")[0] == f"{values[name]:.3f}"
            assert cell.startswith("*") == (values[name] == min(values.values()))


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


def test_a_constant_is_named_where_methods_are_ranked(scores):
    methods = [scores["two"], scores["half"] | {"constant_px": -3.0}]
    shown = ranking(methods, None)
    named = {cells[0].key: cells[0].text for cells in shown.groups[0][1]}
    assert named == {"Two": "Two", "Half": "Half\nconstant −3 px"}


def test_a_method_s_distribution_of_errors_agrees_with_its_d1(compared, scores):
    for name, of in scores.items():
        shares = {
            float(row["error_px"]): float(row["share"])
            for row in rows(compared / f"benchmark/{name}/cumulative.csv")
        }
        assert list(shares.values()) == sorted(shares.values())
        for limit in (1.0, 3.0):
            d1 = of["all"][f"filled_d1_{limit:g}_px_share"]
            assert shares[limit] == pytest.approx(1 - d1, abs=2e-6)
    two = {r["error_px"]: r["share"] for r in rows(compared / "benchmark/two/cumulative.csv")}
    assert (float(two["1.9"]), float(two["2.1"])) == (0, 1)  # it is off by 2 px, everywhere


def test_charts_have_a_line_and_a_point_where_the_files_say(compared):
    folders = [compared / "benchmark" / name for name in ("two", "half")]
    methods = read_scores(folders)
    lines = re.findall(r"<title>(.*?)</title>", cumulative_chart(methods, folders).svg)
    assert lines == ["Two", "Half"]
    said = re.findall(r"<title>(.*?)</title>", strata_chart(methods).svg)
    assert len(said) == sum(len(of["strata"]) for of in methods)
    for of in methods:
        for row in of["strata"]:
            name = f"{of['label']}, {row['stratum'].replace('_', ' ')}"
            assert any(f"{name}: {row['filled_epe_px']:.3f}" in text for text in said)


SORT = """
const table = document.querySelector("#strata table"), head = table.tHead.rows[0].cells[1];
const values = () => [...table.tBodies[0].rows].map((r) => Number(r.cells[1].dataset.key));
head.querySelector("button").click();
const up = values();
head.querySelector("button").click();
return { up, down: values(), wide: document.documentElement.scrollWidth - innerWidth };
"""


@needs_chromium
def test_a_click_on_a_heading_sorts(compared, tmp_path):
    seen = look(Path(compared / "compared/index.html"), tmp_path, SORT, 390)
    assert seen.wrong == [] and seen.requests == []
    found = seen.found
    assert len(found["up"]) > 1 and found["up"] == sorted(found["up"])
    assert found["down"] == found["up"][::-1]
    assert found["wide"] <= 0


SLIDE = """
const slider = document.querySelector(".slider"), [left, right] = slider.querySelectorAll("select");
const seen = () => [...slider.querySelectorAll("img")].filter((i) => i.offsetParent).map(
  (i) => [i.dataset.name, i.className, i.naturalWidth > 0]);
const corners = () => [...slider.querySelectorAll(".corner")].map((c) => c.textContent);
const found = { names: [...left.options].map((o) => o.value), first: seen() };
left.value = "truth"; right.value = "Two";
right.dispatchEvent(new Event("change"));
return { ...found, then: seen(), corners: corners() };
"""


@needs_chromium
def test_two_methods_can_be_laid_over_each_other(compared, tmp_path):
    seen = look(Path(compared / "compared/index.html"), tmp_path, SLIDE)
    assert seen.wrong == []
    names = ["left image", "truth", "Two", "Half", "error of Two", "error of Half"]
    assert seen.found["names"] == names
    assert seen.found["first"] == [["error of Two", "over", True], ["error of Half", "under", True]]
    assert seen.found["then"] == [["truth", "over", True], ["Two", "under", True]]
    assert seen.found["corners"] == ["truth", "Two"]
