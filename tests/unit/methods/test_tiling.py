"""Tiles of a method: what each one sees, no seams, offsets that hold the relief."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.methods.sgm import SemiGlobalMatcher
from stereobench.methods.tiling import Tiling, best_offset, blend, find_offsets, reduced
from stereotruth.core.errors import InputError

from ...synthetic.exact_method import SHAPE, Exact, coded, plane_with_step
from ...synthetic.images import textured
from ...synthetic.whole_images import match


@pytest.mark.parametrize(("block", "overlap"), [(64, 0), (32, 16), (512, 64)])
def test_tiles_see_all_that_the_method_needs(block, overlap):
    truth = plane_with_step()
    left, right, known = coded(truth)
    found = match(Exact(), left, right, (-8, 24), block=block, overlap=overlap)
    assert found.dtype == np.float32
    assert np.array_equal(np.isfinite(found), known)
    assert np.abs(found - truth)[known].max() < 1e-3


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


def test_offsets_of_blocks_bring_a_large_relief_into_a_small_range():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    truth = 0.4 * x - 0.2 * y - 30.0
    left, right, known = coded(truth)
    tiling = Tiling(SHAPE, 32, 8)
    offsets = np.zeros(tiling.count, int)
    for place in tiling.places():
        offsets[place] = np.rint(truth[tiling.block_window(place)].mean())
    given = {"block": 32, "overlap": 8}
    found = match(Exact(), left, right, (-16, 16), offset=offsets, **given)
    assert np.abs(found - truth)[known].max() < 1e-3
    assert np.isnan(match(Exact(), left, right, (-16, 16), **given)).mean() > 0.5


@pytest.mark.slow
def test_offsets_are_found_from_the_images():
    y, x = np.mgrid[:512, :1024]
    truth = 0.2 * x - 100 + 5 * np.sin(y / 40)
    left, right = textured(truth)
    left[200:, 700:] = 0  # nodata
    tiling = Tiling((512, 1024), 128, 32)
    found = find_offsets(left, right, tiling, (-24, 40), (-150, 150))
    assert found.in_range > 0.995
    for place in tiling.places():
        here = tiling.block_window(place)
        if (left[here] != 0).all() and 100 < here[1].start < 900:
            assert found.known[place]
            assert abs(found.offsets[place] - truth[here].mean()) < 16
    assert not found.known[-1, -1]
    disparity = match(
        SemiGlobalMatcher(), left, right, (-24, 40), block=128, overlap=32, offset="auto"
    )
    known = np.isfinite(disparity)
    assert known[:, 120:].mean() > 0.9 * (left[:, 120:] != 0).mean()
    assert np.median(np.abs(disparity - truth)[known]) < 0.1
    assert not known[200:, 700:].any()


def test_the_best_offset_holds_the_most_and_is_near_the_median():
    assert best_offset(np.array([3.0, 4.0, 5.0]), (-64, 128)) == (4, 1.0)
    ground, towers = np.full(900, 10.0), np.full(100, 130.0)
    offset, share = best_offset(np.concatenate([ground, towers]), (-64, 128))
    assert share == 1.0
    assert offset == 130 - 128 + 8 + 1  # the towers in range, with the reserve
    offset, share = best_offset(np.concatenate([ground, ground + 300]), (-64, 128))
    assert share == 0.5


def test_reduced_images_are_means_of_what_there_is():
    image = np.arange(1, 31, dtype=np.uint16).reshape(5, 6)
    image[0, 0] = 0
    found = reduced(image, 2)
    assert found.shape == (3, 3)
    assert found[0, 0] == np.float32((2 + 7 + 8) / 3)
    assert found[2, 0] == np.float32((25 + 26) / 2)
    image[:2, :2] = (0, 0), (0, 9)
    assert reduced(image, 2)[0, 0] == 0
    assert np.array_equal(reduced(np.dstack([image] * 3), 1), image)


def test_images_that_nowhere_match_are_refused():
    rng = np.random.default_rng(3)
    left, right = rng.integers(1, 1000, (2, 200, 300), dtype=np.uint16)
    left[:] = 0
    with pytest.raises(InputError):
        find_offsets(left, right, Tiling((200, 300), 128, 16), (-16, 16))
