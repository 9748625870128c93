"""Tiles of a method put together: what each one sees, no seams, offsets that hold the relief."""

from __future__ import annotations

from dataclasses import dataclass

import dask.array as da
import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.matching.scenes.offsets import best_offset, find_offsets, reduced
from stereotruth.matching.scenes.scene_tiles import blend
from stereotruth.matching.scenes.tiling import Tiling, view_of
from stereotruth.matching.scenes.whole_images import match
from stereotruth.matching.sgm import SemiGlobalMatcher

SHAPE = (150, 230)


@dataclass
class Exact:
    """Reads the disparity from images of three bands, and spoils what lies in its margin.

    Bands: the right column that a pixel corresponds to, its row, its column, each + 1.
    """

    margin_px: int = 10
    spread: float = 0.0  # of a constant that each tile is off by

    def __call__(self, left, right, disparity_range, scaling=None):
        assert left.shape == right.shape
        assert scaling == "whole"
        codes = right[..., 0].max(axis=0)
        known = np.flatnonzero(codes)
        column = left[..., 0] - codes[known[0]] + known[0]  # in the right part
        found = np.arange(left.shape[1]) - column
        low, high = disparity_range
        bad = (left[..., 0] == 0) | (found < low) | (found >= high)
        bad |= (column < -0.01) | (column > left.shape[1] - 0.99)
        found = np.where(bad, np.nan, found)
        rows, cols = (left[..., k][left[..., k] > 0] for k in (1, 2))
        m = self.margin_px  # where the image goes on beyond its part, there is no truth
        for edge, goes_on in (
            (np.s_[:m], rows.min() > 1),
            (np.s_[-m:], rows.max() < SHAPE[0]),
            (np.s_[:, :m], cols.min() > 1 and codes[0] > 1),
            (np.s_[:, -m:], cols.max() < SHAPE[1] and 0 < codes[-1] < SHAPE[1]),
        ):
            found[edge] += 0.7 * goes_on
        tile = left[left.shape[0] // 2, left.shape[1] // 2, 2]
        return (found + self.spread * np.sin(0.1 * tile)).astype(np.float32)

    def scaling(self, left, right):
        return "whole"


def coded(disparity):
    """Left and right image of a disparity, for Exact, and where it can be told."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    column = x - disparity
    inside = (column >= 0) & (column <= SHAPE[1] - 1)
    left = np.dstack([np.where(inside, column + 1, 0), y + 1, x + 1])
    right = np.dstack([x + 1, y + 1, x + 1])
    return left.astype(np.float32), right.astype(np.float32), inside


def plane_with_step():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 0.05 * x - 0.03 * y + np.where((x > 90) & (y > 40), 7.0, 0.0)


@pytest.mark.parametrize(("block", "overlap"), [(64, 16), (64, 0), (32, 16), (512, 64)])
def test_tiles_see_all_that_the_method_needs(block, overlap):
    truth = plane_with_step()
    left, right, known = coded(truth)
    found = match(Exact(), left, right, (-8, 24), block=block, overlap=overlap)
    assert found.dtype == np.float32
    assert np.array_equal(np.isfinite(found), known)
    assert np.abs(found - truth)[known].max() < 1e-3


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


def test_a_right_part_beyond_the_image_is_no_loss():
    """At the left edge with a negative offset the matches lie far to the right, and so on."""
    for constant in (-60.0, 60.0):
        truth = np.full(SHAPE, constant)
        left, right, known = coded(truth)
        given = {"block": 64, "overlap": 16, "offset": int(constant)}
        found = match(Exact(), left, right, (-4, 4), **given)
        assert np.array_equal(np.isfinite(found), known)
        assert np.nanmax(np.abs(found - truth)) < 1e-3


def test_views_have_the_same_size_and_hold_the_range():
    for offset in (-100, 0, 33):
        view = view_of((500, 600), (slice(100, 200), slice(0, 90)), 20, (-7, 30), offset)
        left, right = view.left[1], view.right[1]
        assert left.stop - left.start == right.stop - right.start
        assert left.start - right.start == offset
        # all right columns of the first and the last pixel, with the margin, that there are
        assert right.start <= max(0 - 20 - 30 - offset, 0)
        assert right.stop >= min(90 + 20 + 7 - offset, 600)


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


def test_dask_arrays_give_the_same_lazily():
    left, right, _ = coded(plane_with_step())
    given = {"block": 64, "overlap": 16}
    lazy = match(
        Exact(), *(da.from_array(a, chunks=(50, 50, 3)) for a in (left, right)), (-8, 24), **given
    )
    assert lazy.chunks == ((64, 64, 22), (64, 64, 64, 38))
    whole = match(Exact(), left, right, (-8, 24), **given)
    assert np.array_equal(lazy.compute(scheduler="threads"), whole, equal_nan=True)


def test_too_much_overlap_is_refused():
    with pytest.raises(ValueError, match="overlap"):
        Tiling(SHAPE, 64, 33)


# ---------------------------------------------------------------- on textured images, with SGM


def textured(disparity, seed=0):
    """uint16 images of a smooth disparity, by a random sum of waves that is known everywhere."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: disparity.shape[0], : disparity.shape[1]].astype(float)
    waves = rng.normal(0, 0.35, (2, 80))
    phases = rng.uniform(0, 6.28, 80)

    def paint(column):
        grey = np.zeros(column.shape)
        for (a, b), phase in zip(waves.T, phases):
            grey += np.sin(a * column + b * y + phase)
        return (1000 + 40 * grey).astype(np.uint16)

    return paint(x - disparity), paint(x)


def test_sgm_in_tiles_is_sgm_at_once():
    y, x = np.mgrid[:400, :600]
    truth = 12 + 8 * np.sin(x / 90) + 6 * np.cos(y / 70)
    left, right = textured(truth)
    matcher = SemiGlobalMatcher()
    at_once = match(matcher, left, right, (-16, 48), block=1024)
    tiled = match(matcher, left, right, (-16, 48), block=128, overlap=32)
    assert np.array_equal(at_once, matcher(left, right, (-16, 48)), equal_nan=True)
    both = np.isfinite(at_once) & np.isfinite(tiled)
    assert both.mean() > 0.9
    assert np.median(np.abs(at_once - tiled)[both]) < 0.05
    steps = np.abs(np.diff(tiled, axis=1))
    seams = np.zeros(599, bool)
    seams[127::128] = True
    assert np.nanmean(steps[:, seams]) < 1.2 * np.nanmean(steps[:, ~seams])


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
    with pytest.raises(InputError, match="do not match anywhere"):
        find_offsets(left, right, Tiling((200, 300), 128, 16), (-16, 16))
