"""EPE, D1, strata, intervals, filled holes and doubts, against sums by hand."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.scores.scores import Doubts, Scorer, Scores, fill_holes

N = np.nan
SCORER = Scorer((-4, 10), (3.0, 1.0))


def score(disparity, truth, strata=None, scorer=SCORER):
    scores = Scores(scorer.thresholds_px)
    arrays = [np.array(values, np.float32) for values in (disparity, truth)]
    scores.add("T_1", "T", scorer.sums(*arrays, strata))
    return scores


def test_only_labels_in_the_range_count():
    """The smallest disparity is in it, the largest not."""
    truth = [[-4.5, -4, 9.5, 10, N]]
    row = score([[0, -4, 8, 0, 0]], truth).row()
    assert row["labelled"] == 2 and row["valid_share"] == 1
    assert row["epe_px"] == row["filled_epe_px"] == 0.75


def test_holes_count_twice_valid_only_and_filled():
    disparity, truth = [[2, N, N, 6]], [[2, 2, 7, 6]]
    row = score(disparity, truth).row()
    assert row["valid_share"] == 0.5 and row["epe_px"] == 0
    assert row["filled_epe_px"] == 1.25  # of 0, 0, 5, 0
    assert row["filled_d1_3_px_share"] == 0.25
    turned = score(disparity, truth, scorer=Scorer((-4, 10), (3.0,), grows_with_height=False))
    assert turned.row()["filled_epe_px"] == 1.25  # of 0, 4, 1, 0


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
    scores, tiles = Scores((3.0, 1.0)), []
    for n in range(count):
        shape = (20, int(rng.integers(10, 40)))
        truth = rng.uniform(-6, 12, shape).astype(np.float32)
        truth[rng.random(shape) < 0.2] = N
        found = (truth + rng.normal(0, 1 + n % 3, shape)).astype(np.float32)
        found[rng.random(shape) < 0.3] = N
        scores.add(f"T_{n}", "AB"[n % 2], SCORER.sums(found, truth))
        tiles.append((found, truth))
    return scores, tiles


def test_pooling_is_over_pixels_not_over_tiles():
    scores, tiles = random_tiles(6)
    for city, chosen in ((None, tiles), ("B", tiles[1::2])):
        counted = [(truth >= -4) & (truth < 10) for _, truth in chosen]
        error = np.concatenate([np.abs(f - t)[c] for (f, t), c in zip(chosen, counted)])
        filled = np.concatenate(
            [np.abs(fill_holes(f) - t)[c] for (f, t), c in zip(chosen, counted)]
        )
        valid = error[np.isfinite(error)]
        row = scores.row(city)
        assert row["labelled"] == error.size
        assert row["valid_share"] == pytest.approx(valid.size / error.size, abs=1e-6)
        assert row["epe_px"] == pytest.approx(valid.mean(), abs=1e-5)
        assert row["d1_3_px_share"] == pytest.approx((valid > 3).mean(), abs=1e-6)
        assert row["filled_epe_px"] == pytest.approx(filled.mean(), abs=1e-5)
        assert row["filled_d1_1_px_share"] == pytest.approx((filled > 1).mean(), abs=1e-6)


def test_intervals_cover_the_truth_as_often_as_they_say():
    """Tiles whose mean error is 1 on average: about 95 of 100 intervals hold 1."""
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(200):
        scores = Scores((3.0,))
        for tile, level in enumerate(rng.exponential(1.0, 30)):
            values = np.array([100, 100, 100 * level, 0, 100 * level, 0])
            scores.add(str(tile), "T", {"all": values})
        low, high = scores.intervals(300, 1)["epe_px"]
        held += low <= 1 <= high
    assert 0.86 < held / 200 < 0.98  # percentile intervals of 30 skewed values are a bit narrow


def test_rows_without_intervals_say_why():
    few = Scores((3.0,))
    for number in range(4):
        few.add(f"t{number}", "KM", {"all": np.array([10, 10, 5.0, 1, 5.0, 1])})
    assert set(few.intervals(100, 1).values()) == {None}
    assert few.no_interval(100) == "4 tiles have such labels, and resampling needs 5"
    few.add("t4", "KM", {"all": np.array([10, 10, 9.0, 1, 9.0, 1])})
    assert few.no_interval(100) is None
    assert None not in few.intervals(100, 1).values()
    assert few.no_interval(0) == "benchmark.bootstrap is 0"


@pytest.mark.parametrize("grows", [True, False])
def test_holes_are_filled_as_by_a_loop(grows):
    rng = np.random.default_rng(3)
    disparity = rng.normal(0, 9, (40, 30)).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.7] = N
    disparity[[0, 11, 12, 39]] = N
    before = disparity.copy()
    found = fill_holes(disparity, grows_with_height=grows)
    lower = min if grows else max
    full = [r for r in range(40) if np.isfinite(disparity[r]).any()]
    for r in range(40):
        row = disparity[min(full, key=lambda n: (abs(n - r), n))]
        for c in range(30):
            sides = [side[np.isfinite(side)] for side in (row[: c + 1][::-1], row[c:])]
            assert found[r, c] == lower(float(side[0]) for side in sides if side.size)
    assert np.array_equal(disparity, before, equal_nan=True)
    assert np.array_equal(fill_holes(found), found)


def doubts(change):
    """What is said of results in [−64, 128) that a ``change`` made of a truth of −20 to 29 px."""
    truth = np.tile(np.arange(-20, 30, dtype=np.float32), (40, 1))
    truth[:4] = np.nan
    found = Doubts((-64, 128))
    found.add(change(np.nan_to_num(truth)).astype(np.float32), truth)
    return found


def nodata(found):
    found[:10] = -999
    return found


def beyond(found):
    found[:, 25:] += np.linspace(200, 300, 25)
    return found


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda d: d + 0.4, None),
        (lambda d: d * np.nan, None),
        # means of |0.5 − 2 d| and of 0.5
        (lambda d: 0.5 - d, "−d would score 0.5 px, d scores 25.7: is the sign turned?"),
        (nodata, "25 % of the values are -999, outside [−64, 128) px: is that nodata?"),
        (beyond, "50 % of the values lie outside [−64, 128) px"),
        (lambda d: 0 * d + 3, "returns the constant 3 px everywhere"),
    ],
)
def test_what_makes_results_doubtful_is_named(change, said):
    lines = doubts(change).lines()
    assert lines[:1] == [] if said is None else lines[0].startswith(said)
