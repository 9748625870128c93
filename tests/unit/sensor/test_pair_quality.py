from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.sensor.pair_quality import USUAL_ROUGHNESS_M, quality_of
from stereotruth.sensor.site_pairs import SitePair

GOOD = SitePair(
    "A", "B", 1.0, 1.0, convergence=12.0, bisector=85.0, asymmetry=3.0, off_nadir=12.0,
    pixel_ratio=1.0, pixel_m=0.5, sun=0.1, shadow=0.0, days=0.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"convergence": 40.0}, "much is hidden"),
        ({"shadow": 1.2}, "shadows move by 1.2"),
    ],
)
def test_what_parts_two_images_lowers_the_prediction_and_is_named(change, words):
    worse = quality_of(replace(GOOD, **change))
    assert worse.matched < quality_of(GOOD).matched - 0.05
    assert words in worse.reason


def test_the_reason_of_a_good_pair_and_of_flat_ones():
    assert quality_of(GOOD).reason.startswith(("alike", "12°"))
    flat = quality_of(replace(GOOD, convergence=2.0))
    assert flat.reason == "heights follow badly: 1 px is 14.3 m"
    assert quality_of(replace(GOOD, convergence=13.0)).reason == "alike in angle and light"
    assert "sun is not known" in quality_of(replace(GOOD, shadow=None, sun=None)).reason


def test_what_stands_on_a_site_lowers_the_prediction_of_all_its_pairs():
    usual = quality_of(GOOD, USUAL_ROUGHNESS_M)
    assert usual == quality_of(GOOD)
    assert quality_of(GOOD, 2.0).matched < usual.matched < quality_of(GOOD, 0.8).matched
    assert quality_of(GOOD, 0.0).matched == quality_of(GOOD, 0.05).matched < 1.0


def test_pairs_of_middling_convergence_give_most():
    """Narrow pairs match and tell little, wide ones tell much where they match."""
    bits = [quality_of(replace(GOOD, convergence=angle)).bits for angle in (3, 5, 20, 60, 80)]
    assert bits[0] < bits[1] < bits[2] > bits[3] > bits[4]
    fine = quality_of(replace(GOOD, pixel_m=0.3))
    assert fine.bits > quality_of(GOOD).bits and fine.matched == quality_of(GOOD).matched


def test_information_about_a_height():
    """A building as high as the standard uncertainty of its height: half a bit a match."""
    pair = replace(GOOD, pixel_m=10.0 / 0.3, convergence=2 * np.degrees(np.arctan(0.5)))
    quality = quality_of(pair)
    assert quality.height_sigma_m == pytest.approx(10.0)
    assert quality.bits == pytest.approx(quality.matched / 2)
