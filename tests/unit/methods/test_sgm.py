"""OpenCV's SGM on images of any depth: exact shifts, ranges, holes, and the bare call."""

from __future__ import annotations

import cv2
import dask.array as da
import numpy as np
import pytest

from stereobench.methods.sgm import (
    MODES,
    GreyMapping,
    SemiGlobalMatcher,
    grey_mapping,
    to_8_bits,
)
from stereotruth.core.errors import InputError

H, W = 60, 160


def pair(shift: int, dtype=np.uint16, seed=0):
    """A random texture, and what the right view sees: left pixel x is right pixel x − shift."""
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.uniform(0, 1, (H, W + 400)).astype(np.float32), (0, 0), 1.2)
    wide = (wide - wide.min()) / (wide.max() - wide.min())
    wide = 200 + 1500 * wide if dtype != np.uint8 else 1 + 254 * wide
    left, right = wide[:, 200 : 200 + W], wide[:, 200 + shift : 200 + shift + W]
    return left.astype(dtype), right.astype(dtype)


@pytest.mark.parametrize("mode", MODES)
def test_a_shift_is_found_in_every_column_that_both_images_show(mode):
    for shift in (-21, 34):
        found = SemiGlobalMatcher(mode=mode)(*pair(shift), (-32, 48))
        assert found.shape == (H, W) and found.dtype == np.float32
        match = np.arange(W) - shift
        seen = (match >= 0) & (match < W)
        assert np.isnan(found[:, ~seen]).mean() > 0.98
        good = found[:, seen]
        assert np.isfinite(good).mean() > 0.98
        assert np.nanmax(np.abs(good - shift)) <= 1.25  # by the padding, next to it
        assert np.nanmax(np.abs(good[3:-3, 3:-3] - shift)) <= 0.25
        assert abs(np.nanmean(good) - shift) < 0.02


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_all_depths_colour_and_threads_give_the_same(dtype):
    left, right = pair(5, dtype)
    before = cv2.getNumThreads()
    found = SemiGlobalMatcher(workers=2)(left, right, (-16, 16))
    assert cv2.getNumThreads() == before
    assert np.isfinite(found[:, 8:]).mean() > 0.98
    assert np.nanmax(np.abs(found[3:-3, 8:-3] - 5)) <= 0.25
    if dtype == np.uint8:
        left, right = (np.repeat(image[..., None], 3, axis=2) for image in (left, right))
        again = SemiGlobalMatcher()(left, right, (-16, 16))
    else:  # parts of an image share its mapping
        matcher = SemiGlobalMatcher()
        again = matcher(left, right, (-16, 16), matcher.scaling(left, right))
    assert np.array_equal(again, found, equal_nan=True)


def test_nodata_of_either_image_is_invalid():
    left, right = pair(6)
    left[:20, 60:90] = 0
    right[30:50, 60:90] = 0
    found = SemiGlobalMatcher(speckle_px=0)(left, right, (-16, 16))
    assert np.isnan(found[:20, 60:90]).all()
    rows, cols = np.nonzero(np.isfinite(found))
    match = cols - np.floor(found[rows, cols] + 0.5).astype(int)
    assert (right[rows, match] != 0).all()
    assert np.isfinite(found[30:50, 110:]).mean() > 0.9


@pytest.mark.parametrize("limits", [(-32, 48), (-48, -16), (0, 20)])
def test_it_is_a_bare_call_on_padded_images(limits):
    """OpenCV looks through a multiple of 16 px; results outside the range are invalid."""
    matcher = SemiGlobalMatcher(speckle_px=0)
    left, right = pair(3)
    low, high = limits
    mapping = matcher.scaling(left, right)
    bare = matcher.opencv(limits)
    before, after = max(low + bare.getNumDisparities(), 0), max(-low, 0)
    padded = [
        cv2.copyMakeBorder(to_8_bits(i, mapping), 0, 0, before, after, cv2.BORDER_REPLICATE)
        for i in (left, right)
    ]
    bare = bare.compute(*padded)[:, before : before + W] / 16
    found = matcher(left, right, limits)
    known = np.isfinite(found)
    assert np.array_equal(found[known], bare[known])
    match = np.arange(W) - np.floor(bare + 0.5)
    outside = (bare < low) | (bare >= high) | (match < 0) | (match >= W)
    assert np.array_equal(known, ~outside)


def test_the_grey_mapping_is_monotone_and_clips_nothing():
    rng = np.random.default_rng(1)
    image = rng.normal(600, 60, (200, 200)).astype(np.uint16)
    image[0, :5] = (0, 1, 30000, 50000, 65535)
    mapping = grey_mapping(image, image)
    levels = mapping(np.arange(1 << 16, dtype=np.uint16)[None])[0].astype(int)
    assert (np.diff(levels) >= 0).all() and levels[0] <= 16 and levels[-1] >= 239
    low, high = int(mapping.low), int(mapping.high)
    assert 470 < low < 485 and 715 < high < 730  # all but two percent at either end
    middle = levels[low : high + 1]
    assert middle[0] == 16 and middle[-1] == 239
    assert np.abs(np.diff(middle, 2)).max() <= 1  # linear, rounded
    assert levels[high + 5] > levels[high]  # the tails go on at the same slope ...
    assert np.diff(levels[high : high + 20]).mean() < np.mean(np.diff(middle))  # ... and bend
    assert np.array_equal(mapping(np.arange(1 << 16, dtype=np.float32)[None])[0], levels)


def test_both_images_have_one_mapping_whatever_the_array():
    left, right = pair(5)
    right = (right * 1.5).astype(np.uint16)
    mapping = grey_mapping(left, right)
    assert mapping.low < np.percentile(left, 4) and mapping.high > np.percentile(right, 95)
    assert grey_mapping(*(da.from_array(image, chunks=50) for image in (left, right))) == mapping
    wider = (np.pad(image, ((0, 300), (0, 0))) for image in (left, right))  # nodata
    assert grey_mapping(*wider) == mapping
    assert grey_mapping(left.astype(np.uint8), right.astype(np.uint8)) is None
    assert grey_mapping(np.zeros_like(left), np.zeros_like(right)) == GreyMapping(0.0, 1.0)


@pytest.mark.parametrize(
    "settings", [{"mode": "full"}, {"block_size": 4}, {"p1": 50, "p2": 40}, {"uncertainty": "no"}]
)
def test_settings_that_cannot_work_are_refused(settings):
    with pytest.raises(InputError):
        SemiGlobalMatcher(**settings)


@pytest.mark.parametrize("kind", ["left_right", "peak_ratio"])
def test_uncertainties_are_larger_where_the_images_differ(kind):
    left, right = pair(5)
    right[20:40, 60:100] = pair(5, seed=8)[1][20:40, 60:100]
    loose = {"left_right_px": None, "speckle_px": 0, "uniqueness_percent": 0}
    plain = SemiGlobalMatcher(**loose)
    matcher = SemiGlobalMatcher(uncertainty=kind, **loose)
    found, sigma = matcher.with_uncertainty(left, right, (-16, 16))
    assert np.array_equal(found, plain(left, right, (-16, 16)), equal_nan=True)
    assert plain.with_uncertainty(left, right, (-16, 16))[1] is None
    checked = SemiGlobalMatcher(speckle_px=0, uniqueness_percent=0)(left, right, (-16, 16))
    assert np.isnan(found).sum() < np.isnan(checked).sum()  # by the left-right check
    assert sigma.dtype == np.float32 and np.nanmin(sigma) >= 0
    assert np.isnan(sigma[np.isnan(found)]).all()
    assert np.isfinite(sigma[np.isfinite(found)]).mean() > 0.9
    good, bad = sigma[5:15, 20:-20], sigma[24:36, 75:95]
    assert np.nanmedian(bad) > 3 * np.nanmedian(good)
    if kind == "left_right":
        assert np.nanmedian(good) < 0.1
