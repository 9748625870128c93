"""The table and the figure of stated uncertainties."""

from __future__ import annotations

import re

import numpy as np
import pytest

from stereobench.scores.confidence import Confidence
from stereobench.scores.confidence_table import (
    NONE,
    confidence_chart,
    confidence_table,
    read_curves,
)
from stereotruth.core.products.files import write_table

from ...synthetic.toy_benchmark import texts

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


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


def test_without_uncertainties_it_says_so():
    silent = [{"label": "Silent", "confidence": []}]
    assert confidence_table(silent).shown[0][0] == NONE


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


def test_pages_of_methods_without_uncertainties_have_no_curves(compared):
    text = (compared / "compared/index.html").read_text()
    assert NONE not in text and 'id="confidence"' not in text
