"""Pandora as a method: sign, nodata, uncertainty, the user's own pipeline, and the bare call."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from stereobench.methods.kinds import KINDS
from stereobench.methods.matcher import UncertainMatcher
from stereobench.methods.methods import make_method
from stereotruth.core.errors import InputError

from ...synthetic.pair_with_block import BLOCK, HEIGHT_PX, make

pandora_pipeline = pytest.importorskip(
    "stereobench.methods.pandora_pipeline",
    reason="Pandora is not installed: pip install '.[pandora]'",
    exc_type=ImportError,
)

RANGE = (-12, 24)
PART = np.s_[80:220, 60:240]


def method(**settings):
    return make_method("census", {"kind": "pandora", **settings})


def images():
    scene = make()
    return scene, *(image.astype(np.uint16) for image in (scene.left, scene.right))


def with_confidence(tmp_path, *methods):
    """A file of a pipeline with these confidence steps instead of the default's."""
    steps = copy.deepcopy(pandora_pipeline.PIPELINE)
    steps = {name: of for name, of in steps.items() if "confidence" not in name}
    names = list(steps)
    found = {name: steps[name] for name in names[:2]}
    found |= {f"cost_volume_confidence.{m}": {"confidence_method": m} for m in methods}
    found |= {name: steps[name] for name in names[2:]}
    file = tmp_path / "pipeline.json"
    file.write_text(json.dumps({"input": {"any": 1}, "pipeline": found}))
    return str(file)


@pytest.fixture(scope="module")
def found():
    scene, left, right = images()
    return scene, *method().with_uncertainty(left, right, RANGE)


def test_the_sign_is_ours_and_errors_are_small(found):
    scene, disparity, _ = found
    error = np.abs(disparity - scene.labels)[PART]
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.15
    left, right, top, bottom = BLOCK
    on_block = disparity[top + 10 : bottom - 10, left + 20 : right - 10]
    assert np.nanmedian(on_block) > HEIGHT_PX - 2  # above the ground: to the larger disparities


def test_negative_and_positive_shifts_and_matches_outside_the_right_image():
    rng = np.random.default_rng(2)
    wide = rng.integers(1, 2000, (48, 140)).astype(np.uint16)
    for shift in (-9, 11):
        left, right = wide[:, 20:116], wide[:, 20 + shift : 116 + shift]
        left[20:30, 40:50] = 0
        disparity, sigma = method().with_uncertainty(left, right, (-16, 16))
        assert np.isnan(disparity[20:30, 40:50]).all() and np.isnan(sigma[20:30, 40:50]).all()
        match = np.arange(96) - shift
        seen = (match >= 6) & (match < 90)
        assert np.nanmedian(np.abs(disparity[4:-4, seen] - shift)) < 0.05
        outside = (np.arange(96) - disparity < -0.5) | (np.arange(96) - disparity > 95.5)
        assert not outside.any()
        low, high = np.nanmin(disparity), np.nanmax(disparity)
        assert low >= -16.5 and high <= 15.5


def test_intervals_become_standard_uncertainties(found):
    _, disparity, sigma = found
    assert sigma.shape == disparity.shape and sigma.dtype == np.float32
    known = np.isfinite(disparity)
    assert np.isfinite(sigma[known]).mean() > 0.99 and np.isnan(sigma[~known]).all()
    # whole px, at least one on either side, over twice the 1.645 of 90 %
    px = sigma[np.isfinite(sigma)] * 2 * 1.6448536
    assert np.abs(px - np.rint(px)).max() < 1e-3 and px.min() == pytest.approx(2)


@pytest.mark.slow
def test_the_last_step_of_one_s_own_pipeline_tells_the_uncertainty(found, tmp_path):
    _, left, right = images()
    own = method(pipeline=with_confidence(tmp_path, "interval_bounds", "ambiguity"))
    disparity, sigma = own.with_uncertainty(left, right, RANGE)
    assert np.array_equal(disparity, found[1], equal_nan=True)
    assert np.nanmin(sigma) >= 0 and np.nanmax(sigma) <= 1
    none = method(pipeline=with_confidence(tmp_path))
    assert isinstance(none, UncertainMatcher)
    assert none.with_uncertainty(left, right, RANGE)[1] is None


def test_pipelines_that_pandora_does_not_take_are_refused(tmp_path):
    file = tmp_path / "mine.json"
    wrong = {"pipeline": {"disparity": {"disparity_method": "wta"}}}
    for content in (None, "{}", json.dumps(wrong)):
        if content is not None:
            file.write_text(content)
        with pytest.raises(InputError, match=r"mine\.json"):
            method(pipeline=str(file))


@pytest.mark.slow
def test_mccnn_has_our_sign_an_uncertainty_and_its_weights_among_its_files():
    pytest.importorskip("pandora_plugin_mc_cnn", reason="pip install '.[mccnn]'")
    pytest.importorskip("torch", reason="pip install '.[mccnn]'")
    scene, left, right = images()
    disparity, sigma = method(pipeline="mccnn").with_uncertainty(left, right, RANGE)
    error = np.abs(disparity - scene.labels)[PART]
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.3
    assert np.array_equal(np.isfinite(sigma), np.isfinite(disparity))
    (weights,) = KINDS["pandora"].files({"pipeline": "mccnn"})
    assert weights.is_file()  # so that scores have its checksum
