"""What images say of labels, on made matches: biases that are known, tails and clusters."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.config.configuration import Limits
from stereotruth.tiles.label_doubts import (
    FIGURES,
    Bias,
    agreement,
    bias_of,
    doubts,
    flag,
    missed,
)

SCENES = 150
NEVER = 0.01


def matches(
    rng: np.random.Generator,
    cells: int = 16,
    per_cell: int = 40,
    tail: float = 0.2,
    shared: float = 0.02,
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (px) and cells: a core of 0.14 px, what cells share, a share of tails to one side."""
    cell = np.repeat(np.arange(cells), rng.poisson(per_cell, cells) + 1)
    errors = rng.normal(0, shared, cells)[cell] + rng.normal(0, 0.14, cell.size)
    bad = rng.random(cell.size) < tail
    errors[bad] -= rng.exponential(0.5, bad.sum())
    return errors, cell


def found(planted: float, stated: float = 0.01, **made) -> list[Bias]:
    """What is said of many scenes with a planted bias, as labels of that uncertainty state it."""
    rng = np.random.default_rng(27)
    biases = []
    for _ in range(SCENES):
        errors, cell = matches(rng, **made)
        bias = bias_of("open ground", errors + planted, cell, np.full(errors.size, stated))
        assert bias is not None
        biases.append(bias)
    return biases


@pytest.mark.parametrize("made", [{"cells": 7, "per_cell": 15}, {"shared": 0.06}])
def test_standard_error_is_the_scatter_of_scenes(made):
    biases = found(0.0, tail=0.0, **made)
    scatter = np.std([bias.value for bias in biases])
    assert np.mean([bias.error for bias in biases]) == pytest.approx(scatter, rel=0.15)


@pytest.mark.parametrize("made", [{"cells": 8, "per_cell": 20}, {"tail": 0.3}])
def test_a_planted_bias_is_named_with_its_amount_and_nothing_is_where_none_is(made):
    named = [doubts([bias], NEVER) for bias in found(0.15, **made)]
    assert np.mean([bool(of) for of in named]) >= 0.95
    assert not any(of[0].explained for of in named if of)
    assert np.mean([bool(doubts([bias], NEVER)) for bias in found(0.0, **made)]) <= 0.01


def test_what_the_alignment_explains_is_a_remark_if_it_is_large():
    for bias in found(0.25, stated=0.2)[:20]:
        (doubt,) = doubts([bias], NEVER)
        assert doubt.explained
    assert not any(doubts([bias], NEVER) for bias in found(0.05, stated=0.2)[:20])


def test_few_cells_say_nothing_and_crowns_raise_no_doubt():
    errors = np.random.default_rng(3).normal(0.3, 0.1, 400)
    stated = np.full(400, 0.01)
    assert bias_of("roofs", errors, np.arange(400) // 100, stated) is None
    lopsided = np.where(np.arange(400) < 380, 0, np.arange(400))
    assert bias_of("roofs", errors, lopsided, stated) is None
    assert bias_of("roofs", errors[:0], lopsided[:0], stated[:0]) is None
    crowns = bias_of("crowns", errors, np.arange(400) // 20, stated)
    assert crowns is not None
    assert crowns.value == pytest.approx(0.3, abs=0.03)
    assert doubts([crowns], NEVER) == []
    assert agreement([crowns]) is None


def test_agreement_is_a_probability_of_all_that_is_judged():
    good = [bias_of("open ground", *matches(np.random.default_rng(k)), np.zeros(1)) for k in (1, 2)]
    assert agreement(good) > NEVER
    far = Bias("roofs", 400, 16.0, 0.15, 0.01, 0.01)
    chance = far.chance(far.stated)
    assert agreement([far]) == pytest.approx(chance)
    assert agreement([far, far]) == pytest.approx(2 * chance)
    assert doubts([far], None) == []


# ------------------------------------------------------------------ limits


GOOD = {
    "gcp_rms_px": 0.4,
    "y_parallax_median_px": -0.1,
    "sift_median_error_px": 0.2,
    "sift_mean_absolute_error_px": 0.3,
    "sift_matches": 500,
    "warp_correlation": 0.97,
    "agreement": 0.4,
}
LIMITS = Limits()
NO_LIMITS = Limits(**dict.fromkeys(Limits.model_fields))


@pytest.mark.parametrize(
    ("gate", "value"),
    [
        ("max_gcp_rms_px", 1.01),
        ("max_y_parallax_px", -0.6),
        ("max_sift_error_px", -1.0),
        ("max_sift_mean_absolute_error_px", 1.2),
        ("min_sift_matches", 9),
        ("min_warp_correlation", 0.2),
        ("min_agreement", 0.003),
    ],
)
def test_each_gate_finds_its_figure_and_can_be_switched_off(gate, value):
    figures = {**GOOD, FIGURES[gate]: value}
    (miss,) = missed(figures, LIMITS)
    assert (miss.gate, miss.value, miss.limit) == (gate, value, getattr(LIMITS, gate))
    assert flag([miss]) == gate
    assert missed(figures, NO_LIMITS) == []


def test_limits_are_kept_when_met_exactly_and_absent_figures_miss_nothing():
    exact = dict(zip(FIGURES.values(), (1.0, -0.5, 0.5, 1.0, 10, 0.5, 0.01)))
    assert missed(exact, LIMITS) == missed(GOOD, LIMITS) == []
    assert flag([]) == "ok"
    assert missed({"sift_matches": 11, "warp_correlation": float("nan")}, LIMITS) == []


def test_a_few_matches_say_nothing_of_errors():
    bad = {**GOOD, "sift_matches": 3, "sift_median_error_px": 2.0, "warp_correlation": 0.1}
    assert flag(missed(bad, LIMITS)) == "min_sift_matches;min_warp_correlation"
    none = {"sift_matches": 0, "sift_median_error_px": None}
    assert flag(missed(none, LIMITS)) == "min_sift_matches"
