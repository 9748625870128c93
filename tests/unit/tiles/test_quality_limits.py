from __future__ import annotations

import pytest

from stereotruth.core.config.configuration import Limits
from stereotruth.tiles.quality_limits import FIGURES, flag, missed

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


def test_good_figures_miss_nothing():
    assert missed(GOOD, LIMITS) == []
    assert flag([]) == "ok"


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
    for word in (f"{value:.3g}", FIGURES[gate], gate):
        assert word in str(miss)
    assert missed(figures, NO_LIMITS) == []


def test_limits_are_kept_when_met_exactly_and_absent_figures_miss_nothing():
    exact = dict(zip(FIGURES.values(), (1.0, -0.5, 0.5, 1.0, 10, 0.5, 0.01)))
    assert missed(exact, LIMITS) == []
    assert missed({"sift_matches": 11, "warp_correlation": float("nan")}, LIMITS) == []


def test_a_few_matches_say_nothing_of_errors():
    bad = {**GOOD, "sift_matches": 3, "sift_median_error_px": 2.0, "warp_correlation": 0.1}
    assert flag(missed(bad, LIMITS)) == "min_sift_matches;min_warp_correlation"
    none = {"sift_matches": 0, "sift_median_error_px": None}
    assert flag(missed(none, LIMITS)) == "min_sift_matches"
