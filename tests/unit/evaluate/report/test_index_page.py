"""The index of all pages: what it says is what the files say, and its links lead somewhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.evaluate.labels_against_truth import Comparison, SceneComparison
from stereotruth.evaluate.report.index_page import pages_of, pages_with, write_index
from stereotruth.pages.page import INDEX

EXPORT = {
    "size_px": 256,
    "labelled_pairs": 4,
    "splits": {"realised": {"train": 2, "val": 1, "test": 1, "none": 0}},
    "share_of_pixels": {"labelled": 0.8, "labelled_between": 0.029, "no_points": 0.171},
    "label_uncertainty": {"all": {"uncertainty_median_px": 0.0412, "uncertainty_p95_px": 0.104}},
    "quality": {
        "scenes": {"A-1": {"sift_mean_absolute_error_px": 0.2416}},
        "flagged_tiles": {"A_1": "max_sift_error_px"},
    },
}


def scores(label, epe):
    row = {"filled_epe_px": epe, "filled_d1_3_px_share": 0.0421, "valid_share": 0.9}
    return {"label": label, "tiles": 7, "thresholds_px": [3.0, 1.0], "all": row}


def put(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


@pytest.fixture
def folder(tmp_path):
    for page in ("results/report/A b", "benchmark/own", "audit/own"):
        put(tmp_path / page / "index.html", "<title>page</title>")
    put(tmp_path / "tiles/A b/export.json", json.dumps(EXPORT))
    put(tmp_path / "tiles/A b/manifest.csv", "tile\n")
    truth = SceneComparison("A b")
    truth.all_tiles.parts["ground"] = Comparison()
    truth.all_tiles.parts["ground"].errors.add(np.array([0.0114, -0.0314]))
    put(tmp_path / "results/evaluate/A b/truth.json", json.dumps(truth.figures()))
    for name, epe in (("sgm", 1.25), ("net", 0.5)):
        put(tmp_path / f"benchmark/own/{name}/scores.json", json.dumps(scores(name.upper(), epe)))
        put(tmp_path / f"benchmark/own/{name}/cities.csv", "city\n")
    verdicts = {"pairs": 12, "verdicts": {"good": 9, "fault": 2, "undecided": 1}}
    put(tmp_path / "audit/own/summary.json", json.dumps(verdicts))
    put(tmp_path / "audit/own/pairs.csv", "pair\n")
    return tmp_path


def test_figures_are_those_of_the_files(folder):
    text = write_index(folder).read_text()
    rows = [
        [re.sub("<.*?>", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)]
        for row in text.split("<tr>")
    ]
    city = ["4", "256", "82.9 %", "0.041", "0.1", "2", "1", "1", "0.021", "0.24", "1"]
    assert ["A b", "where the tiles are", *city, "manifest.csv"] in rows
    net, sgm = (
        rows.index(["own", label, f"{epe} px", "4.21 % (&gt; 3 px)", "90.0 %", "7"])
        for label, epe in (("NET", "0.500"), ("SGM", "1.250"))
    )
    assert net < sgm
    heads = dict(re.findall(r'<dt>(.*?)</dt><dd class="value">(.*?)</dd>', text))
    assert heads["labelled pairs"] == "4" and heads["train, val, test"] == "2, 1, 1"
    assert heads["labels known to"] == "0.041 px" and heads["labels"] == "0.2 million"
    assert ["own", "12", "9", "2", "1", "pairs.csv"] in rows


def test_every_link_leads_to_a_page_or_a_file(folder):
    out = write_index(folder)
    links = re.findall(r'href="([^"]*)"', out.read_text())
    there = {(out.parent / link).resolve() for link in links if not link.startswith(("#", "http"))}
    assert all(path.exists() for path in there)
    assert {page.resolve() for page in pages_of(folder)} <= there
    assert any(link.startswith("https://doi.org/") for link in links)


def test_without_pages_there_is_no_index(tmp_path):
    put(tmp_path / INDEX, "of pages that were deleted since")
    assert write_index(tmp_path) is None
    assert not (tmp_path / INDEX).exists()


def test_pages_are_found_and_chosen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="stereotruth run report"):
        pages_with([])
    there = [Path("audit/us3d/index.html"), Path("results/report/A/index.html")]
    for page in there:
        page.parent.mkdir(parents=True)
        page.touch()
    assert pages_with([]) == [INDEX, *there]  # the index first, which is what opens
    assert "us3d" in INDEX.read_text(encoding="utf-8")
    assert pages_with(["A"]) == there[1:]
    with pytest.raises(InputError, match="no page of B"):
        pages_with(["B"])
