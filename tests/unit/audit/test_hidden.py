"""Labels of hidden pixels."""

from __future__ import annotations

import numpy as np

from stereobench.audit import hidden
from stereobench.audit.matches import grey

from ...synthetic.pair_with_block import make


def test_hidden_labels_are_those_behind_the_block():
    scene = make(7)
    got = hidden.hidden_labels(scene.exact)
    assert got[scene.hidden].mean() > 0.85  # all but the first px of the fold
    assert got[~scene.hidden].sum() == 0
    mirrored = -scene.exact[:, ::-1]  # heights that fall with d
    assert np.array_equal(hidden.hidden_labels(mirrored, hidden.SMALLER), got[:, ::-1])
    assert hidden.hidden_labels(scene.labels).sum() == 0


def test_images_tell_which_side_of_a_fold_is_in_front():
    scene = make(8)
    low, high = hidden.who_is_in_front(grey(scene.left), grey(scene.right), scene.exact).interval(
        0.05
    )
    # one block spans few cells: the sign is right where it is known
    assert np.isinf(low) or low > 0
    left, right = (grey(image[:, ::-1]) for image in (scene.left, scene.right))
    low, high = hidden.who_is_in_front(left, right, -scene.exact[:, ::-1]).interval(0.05)
    assert np.isinf(high) or high < 0
