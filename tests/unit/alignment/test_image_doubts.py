"""Which image of a site is named: by corrections, and by the shares that match."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stereotruth.alignment.image_doubts import CHANCE, image_doubts, stand_out


def image(length: float = 10.0, refused: str = "") -> dict[str, Any]:
    """Figures of an image whose correction has a length, px."""
    correction = {"col": 0.6 * length, "row": -0.8 * length}
    gcps = {"left_out": []}
    return {"refused": refused, "fixed": False, "correction": correction, "gcps": gcps}


def pair(left: str, right: str, matched: float) -> dict[str, Any]:
    """Figures of a pair."""
    points = round(200 * matched)
    return {
        "left": left, "right": right, "matched": matched, "tie_points": points, "weight": 1.0,
        "reason": "" if points else "no shift stands out",
    }  # fmt: skip


@pytest.mark.parametrize("count", [4, 12, 40])
def test_one_site_in_a_hundred_names_a_good_rpc(count):
    rng = np.random.default_rng(count)
    sites = [stand_out(rng.normal(10.0, 2.0, count), 0.0).any() for _ in range(4000)]
    assert np.mean(sites) == pytest.approx(CHANCE, abs=0.006)


def test_a_large_correction_stands_out_where_a_robust_deviation_is_large_by_chance():
    # Corrections of twelve images, px; one RPC was moved by 15 px. 4.5 robust standard deviations
    # from the median are 21.0 px.
    lengths = np.array([7.1, 9.6, 11.7, 9.4, 8.5, 12.6, 10.8, 12.1, 11.7, 20.5, 10.1, 14.7])
    assert np.flatnonzero(stand_out(lengths, 0.5)).tolist() == [9]
    lengths[9] = 13.4
    assert not stand_out(lengths, 0.5).any()


def test_two_large_corrections_do_not_hide_each_other():
    rng = np.random.default_rng(3)
    lengths = rng.normal(10.0, 2.0, 16)
    lengths[[4, 9]] = 31.0, 32.0
    assert np.flatnonzero(stand_out(lengths, 0.5)).tolist() == [4, 9]


def test_few_or_even_corrections_name_nobody():
    assert not stand_out(np.array([3.0, 90.0]), 0.5).any()
    assert not stand_out(np.array([1.0, 1.01, 1.0, 1.02, 1.3]), 0.5).any()
    assert not stand_out(np.zeros(0), 0.5).any()


def test_the_partner_of_a_poor_image_is_not_named():
    """B has two pairs, and one of them is with A, of which nothing matches."""
    names = "ABCD"
    pairs = [("A", "B", 0.2), ("A", "C", 0.25), ("A", "D", 0.3), ("B", "C", 0.8), ("C", "D", 0.85)]
    doubts = image_doubts(
        {name: image() for name in names}, {f"{a}-{b}": pair(a, b, m) for a, b, m in pairs}
    )
    assert {name for name, texts in doubts.items() if texts} == {"A"}
    assert "30 % match at best" in doubts["A"][0]


def test_a_refused_image_has_no_part_in_the_usual_correction():
    """Its correction is none, as nothing places it: not a small one."""
    lengths = dict(zip("ABCDEFGH", (0.0, 0.0, 10.0, 10.5, 9.5, 10.2, 9.8, 14.5)))
    images = {name: image(length) for name, length in lengths.items()}
    pairs = {f"{a}-{b}": pair(a, b, 0.8) for a, b in zip("ABCDEFG", "BCDEFGH")}
    assert image_doubts(images, pairs)["H"] == []
    for name in "AB":
        images[name] = image(0.0, "neither tie points nor control points place it")
    assert "off by 14.5 px, where 10.1 px" in image_doubts(images, pairs)["H"][0]
