"""From a configuration entry to a method, and methods of positive disparities on any range."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import convolve1d, gaussian_filter

from stereobench.methods import kinds
from stereobench.methods.kinds import KINDS
from stereobench.methods.matcher import Matcher
from stereobench.methods.methods import MovedMethod, make_method, with_polarity
from stereobench.methods.sgm import SemiGlobalMatcher, grey_mapping
from stereobench.methods.user_methods import FunctionMethod
from stereotruth.core.errors import InputError

RANGE = (-128, 64)
SHAPE = (40, 230)


@pytest.mark.parametrize(
    ("kind", "maker", "told"),
    [
        ("sgm", "sgm:SemiGlobalMatcher", {"workers"}),
        ("pandora", "pandora_pipeline:PandoraMethod", {"name"}),
        ("function", "user_methods:_function_method", {"name"}),
        ("command", "user_methods:CommandMethod", {"name", "workers"}),
    ],
)
def test_the_settings_of_a_kind_are_those_that_its_maker_takes(kind, maker, told):
    module, _, name = maker.partition(":")
    module = pytest.importorskip(f"stereobench.methods.{module}", exc_type=ImportError)
    taken = set(inspect.signature(getattr(module, name)).parameters) - told
    assert set(KINDS[kind].settings) == taken


def test_the_settings_of_networks_are_those_that_are_read():
    inference = Path(kinds.__file__).parents[1] / "networks" / "inference.py"
    read = set(re.findall(r'settings\.get\("(\w+)"\)', inference.read_text(encoding="utf-8")))
    assert set(KINDS["stereonet"].settings) == read | {"training"}


@pytest.mark.parametrize(
    ("entry", "word"),
    [
        ({"kind": "raft"}, "raft"),
        ({"kind": "folder", "folder": "y"}, "folder"),
        ({"kind": "sgm", "windw": 3}, "windw"),
        ({"kind": "stereonet", "precison": "bfloat16"}, "precison"),
        ({"kind": "function"}, "function"),
        ({"kind": "command"}, "command"),
        ({"kind": "sgm", "polarity": "negative"}, "negative"),
        ({"kind": "sgm", "outside": "invalid"}, "outside"),
    ],
)
def test_entries_that_cannot_work_are_refused(entry, word):
    with pytest.raises(InputError, match=word) as refusal:
        make_method("mine", entry)
    assert "mine" in str(refusal.value) and "Remedy" in str(refusal.value)


def test_without_torch_a_network_says_what_to_install(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"torch.*extra networks"):
        make_method("stereonet", {"kind": "stereonet"})


def patches():
    """Disparities of both signs, as patches: int[h, w] px."""
    rows, cols = np.indices(SHAPE)
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
    left, right = (i.astype(float) if i.ndim == 2 else i[..., 1] * 1.0 for i in (left, right))
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


def positive_method(polarity):
    """Block matching that sees no negative disparities, and the ranges that it is asked for."""
    asked = []

    def positive(left, right, disparity_range):
        asked.append(disparity_range)
        assert disparity_range[0] >= 0
        return block_matching(left, right, disparity_range)

    return with_polarity("p", FunctionMethod(positive), polarity), asked


@pytest.mark.parametrize("span", [RANGE, (3, 60), (-60, -10), (-40, 0)])
def test_a_positive_matcher_gives_what_one_of_both_signs_gives_to_the_rims(pair, span):
    method, asked = positive_method("positive")
    assert isinstance(method, Matcher)
    found = method(*pair, span)
    assert found.shape == SHAPE and found.dtype == np.float32
    assert np.abs(found - block_matching(*pair, span)).max() < 1e-3
    assert asked == [span if span[0] >= 0 else (0, span[1] - span[0])]
    if span == RANGE:  # and it is not one and the same nonsense
        match = np.indices(SHAPE)[1] - patches()
        seen = (match >= 3) & (match < SHAPE[1] - 3)
        assert (found[seen] < 0).any() and (found[seen] > 0).any()
        assert np.mean(np.abs(found - patches())[seen] < 0.5) > 0.8
        colour = [np.stack([(image // 16).astype(np.uint8)] * 3, axis=2) for image in pair]
        assert np.abs(method(*colour, span) - block_matching(*colour, span)).max() < 1e-3


@pytest.mark.parametrize("span", [RANGE, (-110, -10)])
def test_a_mirrored_matcher_sees_flipped_images_and_gives_disparities_of_the_left_one(pair, span):
    method, asked = positive_method("mirrored")
    found, expected = method(*pair, span), block_matching(*pair, span)
    # equal costs of two disparities are decided by their order, which is turned around
    assert np.mean(np.abs(found - expected) < 1e-3) > 0.8
    match = np.indices(SHAPE)[1] - patches()
    here = (match >= 3) & (match < SHAPE[1] - 3) & (patches() > span[0]) & (patches() < span[1] - 1)
    assert here.any()
    assert np.mean(np.abs(found - patches())[here] < 0.5) > 0.8
    # a range below 0 is one above 0 in the flipped images, and nothing is widened for it
    assert asked == [(11, 111) if span == (-110, -10) else (0, span[1] - span[0])]


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
    method = make_method("s", {"kind": "sgm", "polarity": "positive", "licence": "MIT"})
    assert isinstance(method, MovedMethod) and method.margin_px == SemiGlobalMatcher.margin_px
    assert method.scaling(*pair) == grey_mapping(*pair)
    found = method(*pair, RANGE)
    assert np.isnan(found[~inside & (np.abs(found - patches()) < 0.4)]).all()
