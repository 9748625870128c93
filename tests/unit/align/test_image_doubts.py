"""Which image of a site is named: by corrections, and by the shares that match."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stereocities.rpcs import draw_bias
from stereotruth.align.site_adjustment import CHANCE, NORMAL, image_doubts, stand_out


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


def lengths_of(shifts: np.ndarray) -> np.ndarray:
    """Of corrections [n, 2] px, as they are compared."""
    return np.hypot(*shifts.T) ** NORMAL


@pytest.mark.parametrize("count", [4, 12, 24])
def test_few_sites_without_a_fault_name_an_rpc(count):
    """Errors of RPCs are normal in col and row: one site in twenty, or a few more."""
    rng = np.random.default_rng(count)
    sites = [stand_out(lengths_of(rng.normal(0, 8, (count, 2))), 0.3).any() for _ in range(2000)]
    assert 0.5 * CHANCE < np.mean(sites) < 2.0 * CHANCE


def test_of_three_images_none_is_named_for_two_that_are_alike():
    """As an image and its crop are."""
    assert not stand_out(np.array([0.2, 0.2, 9.0]), 0.3).any()


def test_an_rpc_off_by_15_px_more_is_named_in_most_sites():
    """Of twelve images whose RPCs are off as the simulator's are, 6 to 16 px."""
    rng, named = np.random.default_rng(4), 0
    for _ in range(200):
        shifts = [
            (draw_bias(900, 900, int(seed), "left") - np.eye(2, 3)) @ (449.5, 449.5, 1.0)
            for seed in rng.integers(1 << 31, size=12)
        ]
        shifts = np.array(shifts)
        shifts[5] += np.sign(shifts[5] @ (0.8, 0.6)) * np.array([12.0, 9.0])
        named += np.flatnonzero(stand_out(lengths_of(shifts), 0.3)).tolist() == [5]
    assert named / 200 > 0.8


def test_a_large_correction_stands_out_where_a_robust_deviation_is_large_by_chance():
    # Corrections of twelve images, px; one RPC was moved by 15 px. 4.5 robust standard deviations
    # from the median are 21.0 px.
    lengths = np.array([7.1, 9.6, 11.7, 9.4, 8.5, 12.6, 10.8, 12.1, 11.7, 20.5, 10.1, 14.7])
    assert np.flatnonzero(stand_out(lengths**NORMAL, 0.3)).tolist() == [9]
    lengths[9] = 13.4
    assert not stand_out(lengths**NORMAL, 0.3).any()


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


def test_an_image_that_matches_half_as_well_is_named_and_a_little_less_well_not():
    """Shares of twelve images in their best pairs; over one of them are clouds."""
    names = "ABCDEFGHIJKL"
    for share, poor in ((0.55, {"I"}), (0.75, set())):
        pairs = {
            f"{a}-{b}": pair(a, b, share if "I" in (a, b) else 0.95 - 0.01 * names.index(a))
            for k, a in enumerate(names)
            for b in names[k + 1 :]
        }
        doubts = image_doubts({name: image() for name in names}, pairs)
        assert {name for name, texts in doubts.items() if texts} == poor


def test_a_refused_image_has_no_part_in_the_usual_correction():
    """Its correction is none, as nothing places it: not a small one."""
    lengths = dict(zip("ABCDEFGH", (0.0, 0.0, 10.0, 10.5, 9.5, 10.2, 9.8, 14.5)))
    images = {name: image(length) for name, length in lengths.items()}
    pairs = {f"{a}-{b}": pair(a, b, 0.8) for a, b in zip("ABCDEFG", "BCDEFGH")}
    assert image_doubts(images, pairs)["H"] == []
    for name in "AB":
        images[name] = image(0.0, "neither tie points nor control points place it")
    assert "off by 14.5 px, where 10.1 px" in image_doubts(images, pairs)["H"][0]
