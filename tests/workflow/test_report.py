"""The page of a small city, made by the workflow, and Snakemake's own report with it."""

from __future__ import annotations

import csv

import cv2
import pytest

from ..browser import look, needs_chromium, screenshot

PAGE = "results/report/Tiny/index.html"


ARGUMENTS = ["--configfile", "tiny.yaml", "later.yaml"]


@pytest.mark.slow
@needs_chromium
def test_the_page_of_a_city_shows_every_tile(later, tmp_path):
    page = later.folder / PAGE
    with (later.folder / "tiles/Tiny/manifest.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    labelled = [row["tile"] for row in rows if row["complete"] == "yes"]
    seen = look(
        page,
        tmp_path,
        """
        const stack = document.querySelector(".stack"), range = stack.querySelector("input");
        range.value = 30;
        range.dispatchEvent(new Event("input", { bubbles: true }));
        return {
          tiles: [...document.querySelectorAll("article.tile")].map((t) => t.id),
          loaded: [...document.images].every((i) => i.naturalWidth > 0),
          count: document.images.length,
          clip: getComputedStyle(stack.querySelector(".over")).clipPath,
          sections: [...document.querySelectorAll("section")].map((s) => s.id),
        };
        """,
    )
    assert seen.wrong == []
    assert seen.requests == []
    assert seen.found["tiles"] == [f"tile-{name}" for name in labelled]
    assert seen.found["loaded"]
    assert seen.found["count"] >= 4 * len(labelled) + 1
    assert "70%" in seen.found["clip"]
    # a scene without truth: no such section
    assert {"map", "alignment", "disparities", "tiles"} <= set(seen.found["sections"])
    assert "truth" not in seen.found["sections"]
    for width in (1280, 500):
        image = cv2.imread(str(screenshot(page, tmp_path / f"{width}.png", width, 3000)))
        assert image.shape[:2] == (3000, width)
        assert image[1000:].std() > 15


def test_another_number_of_large_pictures_makes_the_page_alone(later):
    (later.folder / "fewer.yaml").write_text("report: {sliders: 1}\n")
    jobs = later.plan("report", *ARGUMENTS, "fewer.yaml")
    assert set(jobs) == {"report_city", "report"}


def test_snakemake_makes_its_own_report_of_all_that_it_marks(later):
    run = later.snakemake("report", *ARGUMENTS, "--report", "all.html")
    assert run.status == 0, run.text[-4000:]
    text = (later.folder / "all.html").read_text(encoding="utf-8")
    for word in ("coverage.png", "contact_sheet.png", "residuals.png", "index.html"):
        assert word in text
    for caption in ("Where the tiles lie", "Residuals of the ground control points"):
        assert caption in text
