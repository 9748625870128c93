"""Differences of methods on the same tiles, against what is known of them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from stereobench.scores.differences import difference, differences

from ...synthetic.toy_benchmark import texts

FIELDS = ["tile", "labelled", "filled_epe_px", "filled_d1_3_px_share"]


def folder(path: Path, rows: list[tuple]) -> Path:
    path.mkdir()
    with (path / "scores.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([FIELDS, *rows])
    return path


def of(name: str) -> dict:
    return {"label": name, "thresholds_px": [3.0], "bootstrap": 500}


@pytest.fixture
def folders(tmp_path: Path) -> list[Path]:
    """Tiles from 1 to 8 px hard; the second method is 0.1 to 0.3 px better on all but one."""
    rng = np.random.default_rng(3)
    hard = np.linspace(1, 8, 12)
    gain = rng.uniform(0.1, 0.3, 12)
    gain[4] = -0.1
    first = [(f"T_{n}", 1000, e, e / 10) for n, e in enumerate(hard)]
    second = [(f"T_{n}", 1000, e - g, e / 10) for n, (e, g) in enumerate(zip(hard, gain))]
    empty = ("T_empty", 0, "", "")
    return [folder(tmp_path / "a", [*first, empty]), folder(tmp_path / "b", [*second, empty])]


def test_a_small_gain_on_hard_and_easy_tiles_is_told(folders: list[Path]) -> None:
    table = differences([of("A"), of("B")], folders, seed=1)
    (row,) = table.rows
    assert (row["method"], row["less"], row["tiles"]) == ("B", "A", 12)
    assert -0.3 < row["epe_px_low"] < row["epe_px"] < row["epe_px_high"] < 0
    assert row["epe_px_better_share"] == pytest.approx(11 / 12, abs=1e-6)
    assert row["d1_share"] == row["d1_share_low"] == row["d1_share_high"] == 0
    assert row["d1_share_better_share"] == 0
    assert "| B minus A | −0.1" in table.markdown() and "| 92 | +0.00 [" in table.markdown()
    assert differences([of("A"), of("B")], folders, seed=1) == table


def test_tiles_count_by_their_pixels() -> None:
    first = {"a": np.array([10.0, 10]), "b": np.array([90.0, 90])}
    second = {"b": np.array([90.0, 180]), "a": np.array([10.0, 0]), "c": np.array([5.0, 5])}
    found = difference(first, second, 100, 1)
    assert found["tiles"] == 2 and found["better"] == 0.5
    assert found["value"] == pytest.approx((180 - 100) / 100)
    assert found["low"] is None  # two tiles are too few
    assert difference(first, {}, 100, 1)["value"] is None


def test_the_interval_covers_a_true_difference() -> None:
    """Of 200 datasets of 30 tiles, about 95 % of the intervals hold the true difference."""
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(200):
        hard, change = rng.gamma(2, 2, 30), rng.normal(0.2, 0.5, 30)
        first = {str(n): np.array([1.0, h]) for n, h in enumerate(hard)}
        second = {str(n): np.array([1.0, h + c]) for n, (h, c) in enumerate(zip(hard, change))}
        found = difference(first, second, 400, 2)
        held += found["low"] < 0.2 < found["high"]
    assert 0.88 < held / 200 < 0.99


def test_three_methods_make_three_pairs_and_one_none(folders: list[Path]) -> None:
    names = [of(name) for name in "ABC"]
    table = differences(names, [*folders, folders[0]], seed=1)
    assert [line[0] for line in texts(table.shown[0][1])] == ["B minus A", "C minus A", "C minus B"]
    assert "One method alone" in differences(names[:1], folders[:1], seed=1).markdown()
