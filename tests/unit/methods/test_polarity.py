"""Methods that see positive disparities only, held against those that see both signs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import convolve1d, gaussian_filter

from stereobench.methods.matcher import Matcher
from stereobench.methods.methods import PositiveMethod, make_method, with_polarity
from stereobench.methods.sgm import SemiGlobalMatcher, grey_mapping, to_8_bits
from stereobench.methods.user_methods import FunctionMethod
from stereotruth.core.errors import InputError

RANGE = (-128, 64)
SHAPE = (40, 230)


def patches(shape=SHAPE):
    """Disparities of both signs, as patches: int[h, w] px."""
    rows, cols = np.indices(shape)
    return np.where((rows // 20 + cols // 40) % 2, -97, 41)


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(4)
    (height, width), beyond = SHAPE, 200
    texture = gaussian_filter(rng.uniform(size=(height, width + 2 * beyond)), 0.8)
    texture = (500 + 3000 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint16)
    match = np.indices(SHAPE)[1] - patches() + beyond
    return np.take_along_axis(texture, match, axis=1), texture[:, beyond : beyond + width]


def block_matching(left, right, disparity_range):
    """Sums of absolute differences of 5 by 5 px, to parts of a pixel; all of the range is seen."""
    low, high = disparity_range
    left, right = left.astype(np.float64), right.astype(np.float64)
    last = left.shape[1] - 1
    column = np.arange(-2, last + 3)  # images go on with their edges
    costs = []
    for x in (column - d for d in range(low, high)):
        difference = np.abs(left[:, np.clip(column, 0, last)] - right[:, np.clip(x, 0, last)])
        # whole numbers, so that equal costs are equal
        costs.append(convolve1d(convolve1d(difference, np.ones(5), 0), np.ones(5), 1)[:, 2:-2])
    costs = np.stack(costs)
    best = np.clip(costs.argmin(axis=0), 1, high - low - 2)
    before, at, after = (np.take_along_axis(costs, best[None] + k, 0)[0] for k in (-1, 0, 1))
    curvature = np.maximum(before - 2 * at + after, 1e-9)
    return low + best + np.clip((before - after) / (2 * curvature), -0.5, 0.5)


def positive_block_matching(left, right, disparity_range):
    assert disparity_range[0] >= 0, "sees no negative disparities"
    return block_matching(left, right, disparity_range)


class PositiveOpenCV:
    """OpenCV's SGM as it is: nothing where the range of matches leaves the right image."""

    margin_px = 128
    invalid_outside = True

    def scaling(self, left, right):
        return grey_mapping(left, right)

    def __call__(self, left, right, disparity_range, scaling=None):
        assert disparity_range[0] == 0
        opencv = SemiGlobalMatcher().opencv(disparity_range)
        found = opencv.compute(*(to_8_bits(image, scaling) for image in (left, right)))
        return np.where(found < 0, np.nan, found / np.float32(16)).astype(np.float32)


@pytest.mark.parametrize("colour", [False, True])
def test_a_positive_matcher_gives_what_one_of_both_signs_gives_to_the_rims(pair, colour):
    if colour:

        def both(left, right, span):
            return block_matching(left[..., 1], right[..., 1], span)

        def positive(left, right, span):
            return positive_block_matching(left[..., 1], right[..., 1], span)

        pair = [np.stack([(image // 16).astype(np.uint8)] * 3, axis=2) for image in pair]
    else:
        both, positive = block_matching, positive_block_matching
    method = with_polarity("p", FunctionMethod(positive), "positive")
    assert isinstance(method, Matcher)
    found, expected = method(*pair, RANGE), both(*pair, RANGE)
    assert found.shape == SHAPE and found.dtype == np.float32
    assert np.abs(found - expected).max() < 1e-3
    # and it is not one and the same nonsense: where the match is seen, the truth is found
    match = np.indices(SHAPE)[1] - patches()
    seen = (match >= 3) & (match < SHAPE[1] - 3)
    assert (found[seen] < 0).any() and (found[seen] > 0).any()
    assert np.mean(np.abs(found - patches())[seen] < 0.5) > 0.8


def test_opencv_of_positive_disparities_gives_that_of_both_signs_but_next_to_the_right_rim(pair):
    expected = SemiGlobalMatcher()(*pair, RANGE)
    found = with_polarity("p", PositiveOpenCV(), "positive")(*pair, RANGE)
    same = (np.abs(found - expected) <= 1e-3) | (np.isnan(found) & np.isnan(expected))
    assert np.mean(np.isfinite(expected)) > 0.5
    assert same[:, :30].all() and np.mean(same) > 0.99
    # without more columns, those whose range of matches leaves the image would be lost
    assert np.isfinite(found[:, :30]).any()


@pytest.mark.parametrize("span", [RANGE, (3, 60), (-110, -10)])
def test_a_mirrored_matcher_sees_flipped_images_and_gives_disparities_of_the_left_one(pair, span):
    asked = []

    def positive(left, right, disparity_range):
        asked.append(disparity_range)
        return positive_block_matching(left, right, disparity_range)

    method = with_polarity("p", FunctionMethod(positive), "mirrored")
    found, expected = method(*pair, span), block_matching(*pair, span)
    # equal costs of two disparities are decided by their order, which is turned around
    assert np.mean(np.abs(found - expected) < 1e-3) > 0.8
    match = np.indices(SHAPE)[1] - patches()
    here = (match >= 3) & (match < SHAPE[1] - 3) & (patches() > span[0]) & (patches() < span[1] - 1)
    assert here.any()
    assert np.mean(np.abs(found - patches())[here] < 0.5) > 0.8
    # a range below 0 is one above 0 in the flipped images, and nothing is widened for it
    low, high = asked[0]
    assert (low, high) == ((11, 111) if span == (-110, -10) else (0, span[1] - span[0]))


def test_what_matches_outside_is_kept_or_not(pair):
    match = np.indices(SHAPE)[1] - patches()
    inside = (match >= 0) & (match < SHAPE[1])

    def truth(left, right, disparity_range):
        low_side = left.shape[1] - SHAPE[1] - 1
        return np.pad(patches() + 128, ((0, 0), (low_side, 1)))

    function = FunctionMethod(truth)
    assert np.array_equal(with_polarity("t", function, "positive")(*pair, RANGE), patches())
    found = with_polarity("t", function, "positive", "invalid")(*pair, RANGE)
    assert np.array_equal(np.isfinite(found), inside) and 0.1 < np.mean(inside) < 0.9
    found = make_method("s", {"kind": "sgm", "polarity": "positive"})(*pair, RANGE)
    assert np.isnan(found[~inside & (np.abs(found - patches()) < 0.4)]).all()


@pytest.mark.parametrize("span", [(3, 60), (-60, -10), (-40, 0)])
def test_any_range(pair, span):
    asked = []

    def positive(left, right, disparity_range):
        asked.append((left.shape, disparity_range))
        return positive_block_matching(left, right, disparity_range)

    found = with_polarity("p", FunctionMethod(positive), "positive")(*pair, span)
    assert np.abs(found - block_matching(*pair, span)).max() < 1e-3
    if span[0] >= 0:
        assert asked == [(SHAPE, span)]
    else:
        assert asked[0][1] == (0, span[1] - span[0])


def test_statistics_are_those_of_the_images_without_what_is_added(pair):
    seen = []

    class Method(SemiGlobalMatcher):
        def __call__(self, left, right, disparity_range, scaling=None):
            seen.append(scaling)
            return super().__call__(left, right, disparity_range, scaling)

    method = PositiveMethod(Method())
    method(*pair, RANGE)
    assert seen == [grey_mapping(*pair)] == [method.scaling(*pair)]
    assert method.margin_px == SemiGlobalMatcher.margin_px


def test_entries_have_it_and_wrong_ones_are_refused():
    assert isinstance(
        make_method("s", {"kind": "sgm", "polarity": "positive", "licence": "MIT"}), PositiveMethod
    )
    assert isinstance(make_method("s", {"kind": "sgm", "polarity": "any"}), SemiGlobalMatcher)
    with pytest.raises(InputError, match="polarity is 'negative'"):
        make_method("s", {"kind": "sgm", "polarity": "negative"})
    with pytest.raises(InputError, match="outside without polarity"):
        make_method("s", {"kind": "sgm", "outside": "invalid"})
