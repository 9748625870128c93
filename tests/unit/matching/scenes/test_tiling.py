"""Which tiles cover a scene."""

from __future__ import annotations

import numpy as np
import pytest
from whole_images import match

from stereotruth.matching.scenes.tiling import view_of

from ....synthetic.exact_method import Exact, coded, plane_with_step


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
