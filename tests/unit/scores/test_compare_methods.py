"""From predictions to scores, tables, figure 10 and the page."""

from __future__ import annotations

import pytest

from stereotruth.tiles.stereo_dataset import find_pairs

from ...browser import look, needs_chromium

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


def test_the_toy_dataset_is_as_meant(compared):
    assert len(find_pairs(compared / "data", "whu")) == 7
