"""Methods, runs and surface models on the same tiles: told apart, or level."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from stereobench.scores.paired import compare_folders, difference, differences
from stereotruth.core.errors import InputError

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
    table = differences([of("A"), of("B")], [folders[:1], folders[1:]])
    (row,) = table.rows
    assert (row["method"], row["less"], row["tiles"]) == ("B", "A", 12)
    assert -0.3 < row["epe_px_low"] < row["epe_px"] < row["epe_px_high"] < 0
    assert row["epe_px_better_share"] == pytest.approx(11 / 12, abs=1e-6)
    assert row["d1_share"] == row["d1_share_low"] == row["d1_share_high"] == 0
    assert row["d1_share_better_share"] == 0
    assert "| B minus A | −0.1" in table.markdown() and "| 92 | +0.00 [" in table.markdown()
    assert differences([of("A"), of("B")], [folders[:1], folders[1:]]) == table


def test_tiles_count_by_their_pixels() -> None:
    first = {"a": (10, 10.0), "b": (90, 90.0)}
    second = {"b": (90, 180.0), "a": (10, 0.0), "c": (5, 5.0)}
    found = difference([first], [second])
    assert found.tiles == 2 and found.better_share == 0.5
    assert found.value == pytest.approx((180 - 100) / 100)
    assert found.low is None and found.level  # two tiles are too few
    assert difference([first], [{}]).value is None
    assert difference([], [first]).value == 1


SETS, TILES = 100, 100


class Drawn:
    """Runs of methods on tiles that differ by far more than methods do.

    On a tile a run's error has a factor of its own (2.5 %), over all tiles its seed has one.
    """

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.count = self.rng.integers(20_000, 900_000, TILES)
        self.hard = self.rng.lognormal(0.3, 0.6, TILES)

    def run(self, more: float = 0.0, seeds: float = 0.0):
        factor = (1 + more) * np.exp(seeds * self.rng.normal())
        epe = self.hard * factor * np.exp(0.025 * self.rng.normal(size=TILES))
        return {f"T_{k}": (int(n), float(n * e)) for k, (n, e) in enumerate(zip(self.count, epe))}


def level_in(make) -> int:
    """Sets of tiles, of SETS, in which the two sides that ``make`` draws are level."""
    return sum(difference(*make(Drawn(k))).level for k in range(SETS))


def test_seeds_are_level_and_methods_that_differ_by_3_percent_are_not() -> None:
    assert level_in(lambda of: ([of.run()], [of.run()])) >= 95
    assert SETS - level_in(lambda of: ([of.run()], [of.run(0.03)])) >= 95


def test_a_method_against_itself_with_other_seeds_is_level() -> None:
    """Seeds that move all tiles alike by 2 %: a block each; pooled runs would be told apart."""

    def sides(of):
        return tuple([of.run(seeds=0.02) for _ in range(3)] for _ in range(2))

    assert level_in(sides) >= 95
    assert level_in(lambda of: [side[:1] for side in sides(of)]) < 50


def test_no_order_of_tiles_changes_a_bit(folders: list[Path]) -> None:
    sums = [Drawn(k).run() for k in range(2)]
    turned = [dict(reversed(of.items())) for of in sums]
    assert difference(sums[:1], sums[1:]) == difference(turned[:1], turned[1:])


def test_folders_of_scores_are_compared(folders: list[Path]) -> None:
    lines = compare_folders(folders[:1], folders[1:])
    assert "better" in lines[0] and "12 tiles" in lines[0] and "level" in lines[1]
    with pytest.raises(InputError):
        compare_folders(folders[:1], [folders[0].parent])
