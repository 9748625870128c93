"""Tiles of a method put together: what each one sees, no seams, offsets that hold the relief."""

from __future__ import annotations

import numpy as np

from stereobench.methods.tiling import Tiling, blend

from ...synthetic.exact_method import SHAPE, Exact, coded
from ...synthetic.whole_images import match


def test_tiles_that_differ_a_little_leave_no_step():
    left, right, _ = coded(np.full(SHAPE, 5.0))
    spread = 0.45
    found = match(Exact(spread=spread), left, right, (-8, 24), block=64, overlap=32)
    hard = match(Exact(spread=spread), left, right, (-8, 24), block=64, overlap=0)
    steps, hard_steps = (np.nanmax(np.abs(np.diff(d[:, 8:], axis=1))) for d in (found, hard))
    assert hard_steps > 0.2
    assert steps < 2 * spread * 0.75 / 32 + 1e-4  # the steepest slope of the ramp
    assert np.nanmin(found) >= 5 - spread - 1e-4
    assert np.nanmax(found) <= 5 + spread + 1e-4


def test_weights_add_up_and_what_disagrees_is_not_mixed():
    tiling = Tiling((100, 130), 32, 16)
    rng = np.random.default_rng(1)
    level = {place: float(rng.uniform(0, 0.5)) for place in tiling.places()}
    same = {p: np.full((64, 64), 3.0, np.float32) for p in level}
    other = {p: np.full((64, 64), v, np.float32) for p, v in level.items()}
    far = {p: np.full((64, 64), 10.0 * (p[0] + 2 * p[1]), np.float32) for p in level}
    for place in tiling.places():
        shape = tuple(w.stop - w.start for w in tiling.block_window(place))
        assert np.array_equal(blend(tiling, place, same), np.full(shape, 3.0, np.float32))
        assert np.array_equal(blend(tiling, place, far), np.full(shape, far[place][0, 0]))
        found = blend(tiling, place, other)
        around = [level[p] for p in tiling.around(place)]
        assert min(around) - 1e-6 <= found.min() <= found.max() <= max(around) + 1e-6
    # both sides of a border meet in the middle
    beside = blend(tiling, (0, 0), other)[:16, -1], blend(tiling, (0, 1), other)[:16, 0]
    assert np.abs(beside[0] - beside[1]).max() < 0.5 * 0.75 / 16 + 1e-6


def test_tiles_that_are_off_by_pixels_meet_without_a_step():
    """As those of a network are, for different offsets; the edges of buildings stay as they are."""
    tiling = Tiling((256, 512), 256, 64)
    y, x = np.mgrid[: tiling.side, : tiling.side]
    tiles, town = {}, {}
    for place in tiling.places():
        column, row = x + place[1] * 256 - 64, y - 64
        town[place] = np.where((row % 100 < 40) & (column % 60 < 30), 20.0, 0.0)
        bias = (-1.0) ** place[1] * (1.6 + 0.3 * np.sin(row / 100))
        tiles[place] = (town[place] + 0.01 * column + bias).astype(np.float32)
    found = np.hstack([blend(tiling, (0, j), tiles) for j in range(2)])
    step = np.diff(found - np.hstack([town[0, 0][64:-64, 64:-64], town[0, 1][64:-64, 64:-64]]))
    assert np.abs(tiles[0, 0][64:-64, 64 + 256] - tiles[0, 1][64:-64, 64]).min() > 2.5
    assert np.abs(step).max() < 0.01 + 3.8 * 0.75 / 64 + 0.01


def test_a_pixel_is_valid_where_its_own_tile_says_so():
    tiling = Tiling((64, 128), 64, 32)
    tiles = {p: np.zeros((128, 128), np.float32) for p in tiling.places()}
    tiles[0, 0][:, 90:] = np.nan  # columns 58 on
    assert np.array_equal(np.isnan(blend(tiling, (0, 0), tiles))[0], np.arange(64) >= 58)
    assert np.isfinite(blend(tiling, (0, 1), tiles)).all()
