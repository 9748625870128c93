"""From predictions to scores, tables, figure 10 and the page."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereotruth.dataset.stereo_dataset import Pair, StereoDataset, find_pairs
from stereotruth.errors import InputError
from stereotruth.matching.benchmark import panels, published_scores
from stereotruth.matching.benchmark.compare_methods import compare
from stereotruth.matching.benchmark.panels import Column, draw_columns, error_picture
from stereotruth.matching.benchmark.predictions import predict
from stereotruth.matching.benchmark.score_method import choose, describe, score
from stereotruth.matching.benchmark.tables import make_tables, read_scores

from ..browser import look, needs_chromium
from .test_layouts import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SHAPE = (24, 32)
CITIES = {"KM": "train", "WH": "test"}  # Kunming has training tiles, Wuhan none


def settings(**more):
    return {"thresholds_px": [3, 1], "bootstrap": 50, "seed": 1, "panels": 2, **more}


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Two methods on six test pairs of two cities: one is off by 2 px, one by 0.5 px with holes."""
    folder = tmp_path_factory.mktemp("benchmark")
    rng = np.random.default_rng(0)
    for prefix, numbers in (("KM", (1, 2, 3, 9)), ("WH", (1, 2, 3))):
        for n in numbers:
            split = "train" if n == 9 else "test"
            truth = rng.uniform(-3, 3, SHAPE).astype(np.float32)
            truth[:, :4] = np.nan
            image = rng.integers(1, 900, SHAPE).astype(np.uint16)
            for kind, array in (("left", image), ("right", image), ("disparity", truth)):
                place = "disp" if kind == "disparity" else kind
                write(folder / "data" / split / place / f"{prefix}_{kind}_{n}.tiff", array)
            write(folder / "two" / f"{prefix}_{n}.tif", truth + 2)
            holes = truth + 0.5
            holes[:6] = np.nan
            write(folder / "half" / f"{prefix}_{n}.tif", holes)
    dataset = StereoDataset("toy", folder / "data", "whu", (-8, 8))
    methods = {
        "two": {"kind": "folder", "folder": str(folder / "two")},
        "half": {"kind": "folder", "folder": str(folder / "half")},
    }
    for name, of in methods.items():
        out = folder / "match" / name
        predict(dataset, "test", name, of, out, work=folder / ".work")
        more = {"fine_tuned_of": "two"} if name == "half" else {}
        score(dataset, "test", name.title(), out, folder / "benchmark" / name, **settings(**more))
    compare(
        dataset,
        "test",
        [folder / "benchmark" / name for name in methods],
        [folder / "match" / name for name in methods],
        folder / "compared",
        seed=1,
    )
    return folder


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_folder_of_scores_holds_tiles_cities_strata_and_pictures(compared):
    folder = compared / "benchmark/half"
    tiles = rows(folder / "scores.csv")
    assert [row["tile"] for row in tiles] == [f"{c}_{n}" for c in CITIES for n in (1, 2, 3)]
    for row in tiles:
        assert int(row["labelled"]) == 24 * 28 and float(row["valid_share"]) == 0.75
        assert float(row["epe_px"]) == pytest.approx(0.5, abs=1e-5)
        assert float(row["filled_epe_px"]) > 0.5
    kunming, wuhan, total = rows(folder / "cities.csv")
    assert (kunming["city"], wuhan["city"], total["city"]) == ("Kunming", "Wuhan", "all")
    assert int(total["labelled"]) == 6 * 24 * 28 and total["tiles"] == "6"
    assert kunming["epe_px_low"] == ""  # three tiles are too few
    low, mean, high = (float(total[f"filled_epe_px{end}"]) for end in ("_low", "", "_high"))
    assert low < mean < high
    names = [row["stratum"] for row in rows(folder / "strata.csv")]
    assert names == ["all", "near_step", "match_inside", "match_outside"]
    assert sorted(p.name for p in (folder / "panels").iterdir()) == ["KM_2.png", "WH_2.png"]
    summary = json.loads((folder / "scores.json").read_text())
    assert summary["label"] == "Half" and summary["tiles"] == 6
    assert "of the 75.0 % of pixels that are valid; holes filled: EPE" in describe(summary)


def test_scoring_again_gives_the_same_bytes(compared, tmp_path):
    dataset = StereoDataset("toy", compared / "data", "whu", (-8, 8))
    again = settings(fine_tuned_of="two")
    score(dataset, "test", "Half", compared / "match/half", tmp_path / "again", **again)
    files = [p for p in (compared / "benchmark/half").rglob("*") if p.is_file()]
    assert len(files) == 6
    for file in files:
        other = tmp_path / "again" / file.relative_to(compared / "benchmark/half")
        assert file.read_bytes() == other.read_bytes(), file.name


def test_tables_have_the_paper_s_form(compared):
    five = rows(compared / "compared/table5.csv")
    assert [row["method"] for row in five] == ["Two", "Half"]
    assert float(five[0]["filled_epe_px"]) == pytest.approx(2, abs=1e-5)
    assert float(five[0]["filled_d1_3_px_share"]) == 0
    assert float(five[0]["filled_d1_1_px_share"]) == 1
    six = rows(compared / "compared/table6.csv")
    assert [(row["city"], row["group"], row["method"]) for row in six] == [
        ("Kunming", "cities with training tiles", "Two"),
        ("Wuhan", "cities without", "Two"),
    ]
    seven = rows(compared / "compared/table7.csv")
    assert [row["method"] for row in seven] == ["Two", "Half"] * 2
    text = (compared / "compared/table5.md").read_text()
    assert "| Two | 2.000 [2.000, 2.000] | 0.00 [0.00, 0.00] | 100.00 |" in text
    assert "6 pairs, disparities [-8, 8) px" in text
    assert "| near step |" in (compared / "compared/strata.md").read_text()


def summary(method, kind, cities, fine_tuned_of=None):
    figures = ("epe_px", "d1_3_px_share", "filled_epe_px", "filled_d1_3_px_share")
    of = {
        name: dict(zip(figures, (e, d, e, d))) | {"tiles": 1, "labelled": n, "valid_share": 1}
        for name, (n, e, d) in cities.items()
    }
    return {
        "label": method.title(),
        "method": method,
        "fine_tuned_of": fine_tuned_of,
        "settings": {"kind": kind},
        "dataset": "d",
        "split": "test",
        "tiles": 9,
        "disparity_range": [-128, 64],
        "thresholds_px": [3.0],
        "median_seconds": 0.5061,
        "peak_memory_mb": 700.2,
        "device": "CPU",
        "threads": 1,
        "all": {"city": "all", **next(iter(of.values()))},
        "cities": [{"city": name, **row} for name, row in of.items()],
        "strata": [{"stratum": "all", **next(iter(of.values()))}],
    }  # fmt: skip


def test_the_paper_s_figures_stand_apart_and_groups_are_pooled_by_pixels():
    cities = {"Kunming": (100, 1.0, 0.1), "Qichun": (300, 3.0, 0.5), "Wuhan": (50, 4.0, 0.25)}
    methods = [summary("sgm", "sgm", cities), summary("net", "stereonet", cities)]
    methods.append(summary("tuned", "stereonet", cities, fine_tuned_of="net"))
    five, six, seven, _ = make_tables(methods, ["Kunming", "Qichun"], beside_paper=True)
    caption, _, lines = five.shown[1]
    assert caption == "The paper's, on the real WHU-Stereo."
    assert lines == [["SGM", "4.889", "50.79", "506"], ["StereoNet", "2.453", "25.12", "238"]]
    assert five.shown[0][2][0][-2:] == ["506", "700"]
    assert "paper_epe_px" not in five.rows[2]  # the paper's StereoNet was not fine-tuned
    (_, heading, lines), (_, _, published) = six.shown
    assert heading == ["City", "Sgm: EPE (px)", "D1 (%)", "Net: EPE (px)", "D1 (%)"]
    assert lines[2] == ["**cities with training tiles**", *["**2.500**", "**40.00**"] * 2]
    assert [line[0] for line in lines] == ["Kunming", "Qichun", lines[2][0], "Wuhan"]
    assert published[0] == ["Kunming", "3.065", "37.50", "1.225", "6.09"]
    pooled = next(row for row in six.rows if row["city"] == "all of group")
    assert pooled["filled_epe_px"] == 2.5 and pooled["labelled"] == 400
    assert [name for name in seven.shown[0][1] if "EPE" in name] == [
        "Net: EPE (px)",
        "Tuned: EPE (px)",
    ]
    assert seven.rows[1]["paper_epe_px"] == published_scores.TABLE7["Kunming"]["stereonet"][0]
    methods.append(summary("again", "stereonet", cities, fine_tuned_of="net"))
    _, _, both, _ = make_tables(methods, [], beside_paper=False)
    names = [name.partition(":")[0] for name in both.shown[0][1] if "EPE" in name]
    assert names == ["Net", "Tuned", "Again"]
    five, six, seven, _ = make_tables(methods[:2], [], beside_paper=False)
    assert len(five.shown) == len(six.shown) == 1
    assert "fine_tuned_of" in seven.markdown() and seven.csv() == "method\n"


def test_a_city_that_the_paper_lacks_has_no_line_among_its_figures():
    methods = [summary("sgm", "sgm", {"Utopia": (1, 1.0, 0.1), "Yingde": (1, 1.0, 0.1)})]
    _, six, *_ = make_tables(methods, [], beside_paper=True)
    assert [line[0] for line in six.shown[1][2]] == ["Yingde"]


def test_missing_scores_are_told(tmp_path):
    with pytest.raises(InputError, match="no scores"):
        read_scores([tmp_path])


@needs_chromium
def test_the_page_is_whole_and_needs_no_network(compared, tmp_path):
    seen = look(
        compared / "compared/index.html",
        tmp_path,
        "return [document.images.length, [...document.images].every((i) => i.naturalWidth > 0),"
        " document.querySelectorAll('table').length, document.body.innerText]",
    )
    assert seen.wrong == [] and seen.requests == []
    count, loaded, tables, text = seen.found
    assert count == 5 and loaded and tables == 5
    for word in ("Table 5", "Half", "Kunming", "EPE"):
        assert word in text


def test_errors_have_one_scale_and_holes_a_colour():
    truth = np.array([[0, 0, 0, np.nan]], np.float32)
    found = np.array([[0, 6, np.nan, 1]], np.float32)
    none, full, hole, unlabelled = error_picture(found, truth)[0].tolist()
    assert sum(none) < 20 and sum(full) > 600
    assert tuple(hole) == panels.INVALID
    assert tuple(unlabelled) == panels.NO_VALUE


def test_pictures_without_truth_have_no_errors(tmp_path):
    image = np.arange(64, dtype=np.uint16).reshape(8, 8)
    flat = np.full((8, 8), 3.0, np.float32)
    columns = [Column(name, image, image, None, {"M": flat}) for name in ("a", "b")]
    draw_columns(tmp_path / "a.png", columns)
    draw_columns(tmp_path / "b.png", columns, across=True)
    tall, wide = (cv2.imread(str(tmp_path / f"{n}.png")).shape for n in "ab")
    assert tall[0] > tall[1] and wide[1] > wide[0]


def test_pictures_are_chosen_of_all_cities():
    def pairs(**counts):
        return [
            Pair(f"{city}_{n}", city, "test", Path(), Path(), None)
            for city, count in counts.items()
            for n in range(count)
        ]

    names = [pair.name for pair in choose(pairs(A=9, B=1, C=4), 5)]
    assert names == ["A_3", "A_5", "B_0", "C_1", "C_2"]
    assert len(choose(pairs(A=2, B=3), 9)) == 5
    assert choose(pairs(A=2), 0) == []


def test_the_toy_dataset_is_as_meant(compared):
    assert len(find_pairs(compared / "data", "whu")) == 7
