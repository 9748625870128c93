"""Results with a turned sign, nodata as a value and values beyond the range are named."""

import numpy as np
import pytest

from stereobench.scores.doubts import Doubts


@pytest.fixture
def truth():
    """Disparities [40, 50] of −20 to 29 px, a tenth unlabelled."""
    made = np.tile(np.arange(-20, 30, dtype=np.float32), (40, 1))
    made[:4] = np.nan
    return made


def said(found, truth):
    """What is said of one pair in [−64, 128)."""
    doubts = Doubts((-64, 128))
    doubts.add(found, truth)
    return doubts.lines()


def test_good_results_raise_no_doubt(truth):
    assert said(np.nan_to_num(truth) + np.float32(0.4), truth) == []


def test_a_constant_is_named(truth):
    doubts = Doubts((-64, 128))
    doubts.add(np.full_like(truth, 3.0), truth)
    assert doubts.constant_px == 3.0
    assert "constant 3 px" in doubts.lines()[0]
    doubts.add(np.full_like(truth, 4.0), truth)
    assert doubts.constant_px is None


def test_no_values_raise_no_doubt(truth):
    assert said(np.full_like(truth, np.nan), truth) == []


def test_turned_sign_is_named_with_both_scores(truth):
    (line,) = said(np.float32(0.5) - truth, truth)
    # means of |0.5 − 2 d| and of 0.5
    expected = np.abs(0.5 - 2 * truth[np.isfinite(truth)]).mean()
    assert line == f"−d would score 0.5 px, d scores {expected:.3g}: is the sign turned?"


def test_nodata_as_a_value_is_named(truth):
    found = np.nan_to_num(truth)
    found[:10] = -999
    (line,) = said(found, truth)
    assert line.startswith("25 % of the values are -999, outside [−64, 128) px: is that nodata?")


def test_values_beyond_the_range_are_counted(truth):
    found = np.nan_to_num(truth)
    found[:, 25:] += np.linspace(200, 300, 25, dtype=np.float32)
    (line,) = said(found, truth)
    assert line == "50 % of the values lie outside [−64, 128) px"
