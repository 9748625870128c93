"""EPE, D1, strata and confidence intervals, against sums by hand."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.scores.holes import fill_holes
from stereobench.scores.scores import Collector, Scorer

N = np.nan
SCORER = Scorer((-4, 10), (3.0, 1.0))


def score(disparity, truth, strata=None, scorer=SCORER):
    collector = Collector(scorer.thresholds_px)
    arrays = [np.array(values, np.float32) for values in (disparity, truth)]
    collector.add("T_1", "T", scorer.sums(*arrays, strata))
    return collector.scores()


def test_only_labels_in_the_range_count():
    """The smallest disparity is in it, the largest not."""
    truth = [[-4.5, -4, 9.5, 10, N]]
    row = score([[0, -4, 8, 0, 0]], truth).row()
    assert row["labelled"] == 2 and row["valid_share"] == 1
    assert row["epe_px"] == row["filled_epe_px"] == 0.75


def test_errors_at_a_threshold_are_not_beyond_it():
    row = score([[3, -3, 3.5, 1, 1.5, 0]], [[0] * 6]).row()
    assert row["d1_3_px_share"] == pytest.approx(1 / 6, abs=1e-6)
    assert row["d1_1_px_share"] == pytest.approx(4 / 6, abs=1e-6)
    assert row["epe_px"] == pytest.approx(2.0)


def test_holes_count_twice_valid_only_and_filled():
    disparity, truth = [[2, N, N, 6]], [[2, 2, 7, 6]]
    row = score(disparity, truth).row()
    assert row["valid_share"] == 0.5 and row["epe_px"] == 0
    assert row["filled_epe_px"] == 1.25  # of 0, 0, 5, 0
    assert row["filled_d1_3_px_share"] == 0.25
    turned = score(disparity, truth, scorer=Scorer((-4, 10), (3.0,), grows_with_height=False))
    assert turned.row()["filled_epe_px"] == 1.25  # of 0, 4, 1, 0


def test_a_method_without_any_result_has_no_valid_error_and_the_middle_of_the_range():
    row = score([[N, N]], [[1, 5]]).row()
    assert row["valid_share"] == 0 and row["epe_px"] is None and row["d1_3_px_share"] is None
    assert row["filled_epe_px"] == 2.0
    none = score([[1.0]], [[N]]).row()
    assert none["labelled"] == 0 and none["filled_epe_px"] is None and none["valid_share"] is None


def test_strata_are_scored_alone():
    here = np.array([[True, True, False]])
    found = score([[0, N, 9]], [[0, 1, 0]], {"left": here, "right": ~here})
    assert found.strata == ["all", "left", "right"]
    left, right = (found.row(stratum=name) for name in ("left", "right"))
    assert (left["labelled"], left["valid_share"], left["epe_px"]) == (2, 0.5, 0)
    assert left["filled_epe_px"] == 0.5
    assert (right["labelled"], right["epe_px"], right["d1_3_px_share"]) == (1, 9, 1)


def random_tiles(count, seed=0):
    rng = np.random.default_rng(seed)
    collector, tiles = Collector((3.0, 1.0)), []
    for n in range(count):
        shape = (20, int(rng.integers(10, 40)))
        truth = rng.uniform(-6, 12, shape).astype(np.float32)
        truth[rng.random(shape) < 0.2] = N
        found = (truth + rng.normal(0, 1 + n % 3, shape)).astype(np.float32)
        found[rng.random(shape) < 0.3] = N
        collector.add(f"T_{n}", "AB"[n % 2], SCORER.sums(found, truth))
        tiles.append((found, truth))
    return collector.scores(), tiles


def test_pooling_is_over_pixels_not_over_tiles():
    scores, tiles = random_tiles(6)
    for where in (None, scores.in_city("B")):
        chosen = [t for t, use in zip(tiles, where if where is not None else [True] * 6) if use]
        counted = [(truth >= -4) & (truth < 10) for _, truth in chosen]
        error = np.concatenate([np.abs(f - t)[c] for (f, t), c in zip(chosen, counted)])
        filled = np.concatenate(
            [np.abs(fill_holes(f) - t)[c] for (f, t), c in zip(chosen, counted)]
        )
        valid = error[np.isfinite(error)]
        row = scores.row(where)
        assert row["labelled"] == error.size
        assert row["valid_share"] == pytest.approx(valid.size / error.size, abs=1e-6)
        assert row["epe_px"] == pytest.approx(valid.mean(), abs=1e-5)
        assert row["d1_3_px_share"] == pytest.approx((valid > 3).mean(), abs=1e-6)
        assert row["filled_epe_px"] == pytest.approx(filled.mean(), abs=1e-5)
        assert row["filled_d1_1_px_share"] == pytest.approx((filled > 1).mean(), abs=1e-6)


def test_intervals_are_those_of_resampled_tiles():
    scores, _ = random_tiles(12)
    low, high = scores.intervals(4000, 7)["epe_px"]
    rng = np.random.default_rng(1)
    sums = scores.sums[:, 0]
    draws = sums[rng.integers(0, 12, (4000, 12))].sum(axis=1)
    expected = np.percentile(draws[:, 2] / draws[:, 1], (2.5, 97.5))
    assert (low, high) == pytest.approx(tuple(expected), abs=0.02)
    assert low < scores.row()["epe_px"] < high
    assert scores.intervals(4000, 7)["epe_px"] == (low, high)


def test_intervals_cover_the_truth_as_often_as_they_say():
    """Tiles whose mean error is 1 on average: about 95 of 100 intervals hold 1."""
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(200):
        collector = Collector((3.0,))
        for tile, level in enumerate(rng.exponential(1.0, 30)):
            values = np.array([100, 100, 100 * level, 0, 100 * level, 0])
            collector.add(str(tile), "T", {"all": values})
        low, high = collector.scores().intervals(300, 1)["epe_px"]
        held += low <= 1 <= high
    assert 0.86 < held / 200 < 0.98  # percentile intervals of 30 skewed values are a bit narrow


def test_few_tiles_have_no_intervals():
    scores, _ = random_tiles(4)
    assert set(scores.intervals(100, 1).values()) == {None}
    assert set(random_tiles(9)[0].intervals(0, 1).values()) == {None}


def test_rows_without_intervals_say_why():
    few = Collector((3.0,))
    for number in range(4):
        few.add(f"t{number}", "KM", {"all": np.array([10, 10, 5.0, 1, 5.0, 1])})
    scores = few.scores()
    assert set(scores.intervals(100, 1).values()) == {None}
    assert scores.no_interval(100) == "4 tiles have such labels, and resampling needs 5"
    few.add("t4", "KM", {"all": np.array([10, 10, 9.0, 1, 9.0, 1])})
    assert few.scores().no_interval(100) is None
    assert None not in few.scores().intervals(100, 1).values()
    assert few.scores().no_interval(0) == "benchmark.bootstrap is 0"
