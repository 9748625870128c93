"""What labels lie on, by hand."""

from __future__ import annotations

import numpy as np

from stereotruth.tiles.label_surfaces import GUARD_PX, LabelSurface, label_surfaces

SIDE = 120
HOUSE = slice(30, 70)
TREES = slice(80, 100)
SURE = np.full((SIDE, SIDE), 0.01)


def town() -> tuple[np.ndarray, np.ndarray]:
    """Labels and classes: sloping ground, a house, rough trees."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    rng = np.random.default_rng(2)
    disparity = 3.0 + 0.02 * x + 0.01 * y + rng.normal(0, 0.03, (SIDE, SIDE))
    codes = np.full((SIDE, SIDE), 2, np.uint8)
    disparity[HOUSE, HOUSE] += 8.0
    codes[HOUSE, HOUSE] = 6
    disparity[TREES, TREES] += rng.uniform(2, 6, (20, 20))
    codes[TREES, TREES] = 5
    return disparity, codes


def test_surfaces_are_told_away_from_edges():
    disparity, codes = town()
    disparity[5:8, 100:103] = np.nan
    found = label_surfaces(disparity, SURE, codes, codes == 6)
    half = GUARD_PX // 2
    core = slice(HOUSE.start + half, HOUSE.stop - half)
    assert (found[core, core] == LabelSurface.ROOFS).all()
    assert (found == LabelSurface.ROOFS).sum() == (core.stop - core.start) ** 2
    wide = slice(TREES.start - half, TREES.stop + half)
    assert (found[wide, wide] == LabelSurface.CROWNS).all()
    assert (found == LabelSurface.CROWNS).sum() == (wide.stop - wide.start) ** 2
    assert (found[10:22, 10:90] == LabelSurface.OPEN_GROUND).all()
    wide = slice(HOUSE.start - half, HOUSE.stop + half)
    assert not (found[wide, wide] == LabelSurface.OPEN_GROUND).any()
    assert (found[3:10, 98:105] == LabelSurface.NEAR_EDGES).all()


def test_without_classes_what_is_rough_is_crowns():
    disparity, codes = town()
    unknown = np.zeros_like(codes)
    found = label_surfaces(disparity, SURE, unknown, codes == 6)
    assert (found[TREES, TREES] == LabelSurface.CROWNS).mean() > 0.95
    assert (found[40:60, 40:60] == LabelSurface.ROOFS).all()
    assert (found[10:22, 10:90] == LabelSurface.OPEN_GROUND).all()


def test_sparse_labels_are_judged_by_what_is_usual():
    disparity, codes = town()
    rng = np.random.default_rng(4)
    disparity[rng.random(disparity.shape) < 0.1] = np.nan
    found = label_surfaces(disparity, SURE, codes, codes == 6)
    known = np.isfinite(disparity)
    assert (found[~known] == LabelSurface.NEAR_EDGES).all()
    assert (found[10:22, 10:90][known[10:22, 10:90]] == LabelSurface.OPEN_GROUND).mean() > 0.5
    empty = np.full((9, 9), np.nan)
    assert not label_surfaces(empty, SURE[:9, :9], codes[:9, :9], codes[:9, :9] == 6).any()


def test_labels_that_are_less_sure_than_the_others_are_no_open_ground():
    disparity, codes = town()
    sigma = SURE + 0.15  # what all share does not count
    assert label_surfaces(disparity, sigma, codes, codes == 6)[15, 15] == LabelSurface.OPEN_GROUND
    sigma[10:20, 10:20] = 0.5
    found = label_surfaces(disparity, sigma, codes, codes == 6)
    assert (found[8:22, 8:22] == LabelSurface.NEAR_EDGES).all()
    assert (found[10:22, 40:90] == LabelSurface.OPEN_GROUND).all()
