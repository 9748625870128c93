"""Which tiles cover a scene."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest

from stereobench.methods.sgm import SemiGlobalMatcher
from stereobench.methods.tiling import Tiling, view_of

from ...synthetic.exact_method import SHAPE, Exact, coded, plane_with_step
from ...synthetic.images import textured
from ...synthetic.whole_images import match


@pytest.mark.parametrize(("block", "overlap"), [(64, 16), (64, 0), (32, 16), (512, 64)])
def test_tiles_see_all_that_the_method_needs(block, overlap):
    truth = plane_with_step()
    left, right, known = coded(truth)
    found = match(Exact(), left, right, (-8, 24), block=block, overlap=overlap)
    assert found.dtype == np.float32
    assert np.array_equal(np.isfinite(found), known)
    assert np.abs(found - truth)[known].max() < 1e-3


def test_views_have_the_same_size_and_hold_the_range():
    for offset in (-100, 0, 33):
        view = view_of((500, 600), (slice(100, 200), slice(0, 90)), 20, (-7, 30), offset)
        left, right = view.left[1], view.right[1]
        assert left.stop - left.start == right.stop - right.start
        assert left.start - right.start == offset
        # all right columns of the first and the last pixel, with the margin, that there are
        assert right.start <= max(0 - 20 - 30 - offset, 0)
        assert right.stop >= min(90 + 20 + 7 - offset, 600)


def test_a_right_part_beyond_the_image_is_no_loss():
    """At the left edge with a negative offset the matches lie far to the right, and so on."""
    for constant in (-60.0, 60.0):
        truth = np.full(SHAPE, constant)
        left, right, known = coded(truth)
        given = {"block": 64, "overlap": 16, "offset": int(constant)}
        found = match(Exact(), left, right, (-4, 4), **given)
        assert np.array_equal(np.isfinite(found), known)
        assert np.nanmax(np.abs(found - truth)) < 1e-3


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


@pytest.mark.slow
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
