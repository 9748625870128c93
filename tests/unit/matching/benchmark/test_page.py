"""The page of a benchmark: its numbers are those of the JSON and CSV files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from stereotruth.matching.benchmark.page import headlines
from stereotruth.matching.benchmark.page_charts import cumulative_chart, strata_chart
from stereotruth.matching.benchmark.page_tables import sections
from stereotruth.matching.benchmark.tables import Table, plain_table, read_scores
from stereotruth.pages.figures import HEIGHT

from ....browser import look, needs_chromium
from ....synthetic.toy_benchmark import rows

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
    part = re.sub(r'<td class="[^"]*best[^"]*"[^>]*>(.*?)</td>', r"<td>*\1*</td>", part)
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in part.split("<tr>")[2:]]


def test_the_best_is_bold_and_has_its_interval(text, scores):
    two, half = cells(text, "table5")
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


def test_headings_come_before_table_numbers(text):
    headings = re.findall(r"<h2>(.*?)</h2>", text)
    accuracy = r"Accuracy, time and memory <small>table 5 of the paper</small>"
    assert any(re.fullmatch(accuracy, heading) for heading in headings)
    assert not any(heading.startswith("Table") for heading in headings)
    (protocol,) = re.findall(r"Protocol of all scores: <code>(own-\w+)</code>", text)
    assert text.count(protocol) == 1


def test_the_cards_say_who_is_best_and_by_how_much(compared, scores):
    methods = read_scores(compared / "benchmark" / name for name in ("two", "half"))
    (row,) = rows(compared / "compared/differences.csv")
    table = Table("differences", "", [{k: _number(v) for k, v in row.items()}], [])
    cards = headlines(methods, [table])
    assert len(cards) <= 6
    least = min(scores.values(), key=lambda of: of["all"]["filled_epe_px"])
    assert cards[0].title == "least EPE" and cards[0].note.startswith(least["label"])
    assert cards[0].value == f"{least['all']['filled_epe_px']:.3f} px"
    (following,) = (card for card in cards if card.title.startswith("next"))
    between = abs(
        scores["two"]["all"]["filled_epe_px"] - scores["half"]["all"]["filled_epe_px"]
    )  # the same tiles of both: the difference of the pooled figures
    assert following.value == f"+{between:.3f} px"


def _number(value: str) -> str | float | None:
    try:
        return float(value) if value else None
    except ValueError:
        return value


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
    chart = cumulative_chart(methods, folders)
    assert [series.name for series in chart.series] == ["Two", "Half"]
    first, last = (chart.series[0].path[1:].split("L")[k].split()[1] for k in (0, -1))
    assert (float(first), float(last)) == (HEIGHT, 0)  # 0 % at the left, 100 % at the right
    strata = strata_chart(methods)
    for of, series in zip(methods, strata.series):
        assert len(series.points) == len(of["strata"])
        for row, point in zip(of["strata"], series.points):
            assert f"{row['filled_epe_px']:.3f} px" in point.text
            if point.low is not None:
                assert point.low <= point.x <= point.high


def test_another_table_is_shown_as_it_is_written():
    lines = [["A", "1.5 [1.0, 2.0]", "–"], ["B", "-0.5", "7"]]
    shown = plain_table(["Name", "One", "Two"], lines)
    table = Table("more", "More: of it (own-1)", [{"x": 1}], [("A `caption`", shown)])
    empty = Table("none", "None (own-1)", [], [("No scores", plain_table(["Name"], []))])
    (section,) = sections([table, empty], "own-1")
    assert (section.heading, section.also) == ("More: of it", "")
    ((caption, shown),) = section.shown
    assert caption == "A caption"
    assert [column.numeric for column in shown.columns] == [False, True, True]
    (_, ((_, one, dash), (name, other, _))) = shown.groups[0]
    assert (one.text, one.key, dash.key) == ("1.5 [1.0, 2.0]", "1.5", "")
    assert (name.key, other.text, other.key) == ("B", "−0.5", "-0.5")


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


SWIPE = """
const swipe = document.querySelector(".swipe"), [left, right] = swipe.querySelectorAll("select");
const seen = () => [...swipe.querySelectorAll("img")].filter((i) => i.offsetParent).map(
  (i) => [i.dataset.name, i.className, i.naturalWidth > 0]);
const found = { names: [...left.options].map((o) => o.value), first: seen() };
left.value = "truth"; right.value = "Two";
right.dispatchEvent(new Event("change"));
return { ...found, then: seen() };
"""


@needs_chromium
def test_two_methods_can_be_swiped_over_each_other(compared, tmp_path):
    seen = look(Path(compared / "compared/index.html"), tmp_path, SWIPE)
    assert seen.wrong == []
    names = ["left image", "truth", "Two", "Half", "error of Two", "error of Half"]
    assert seen.found["names"] == names
    assert seen.found["first"] == [["error of Two", "over", True], ["error of Half", "under", True]]
    assert seen.found["then"] == [["truth", "over", True], ["Two", "under", True]]
