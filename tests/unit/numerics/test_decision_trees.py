"""Sums of decision trees, against small ones that are followed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereotruth.numerics.decision_trees import COLUMNS, DecisionTrees

TWO_TREES = """\
0	0	-1	0	0	0	0	0.5
0	1	0	2	1	1	2	0
0	1	-1	0	0	0	0	10
0	1	1	-1	0	1	2	0
0	1	-1	0	0	0	0	20
0	1	-1	0	0	0	0	30
1	0	-1	0	0	0	0	7
"""


def sums(folder: Path) -> list[DecisionTrees]:
    file = folder / "trees.tsv"
    file.write_text(COLUMNS.replace(" ", "\t") + "\n" + TWO_TREES)
    return DecisionTrees.load(file)


@pytest.mark.parametrize(
    ("features", "expected"),
    [
        ((1.0, 0.0), 10.5),
        ((2.0, 0.0), 10.5),  # a limit counts as below
        ((3.0, -2.0), 20.5),
        ((3.0, 0.0), 30.5),
        ((np.nan, 0.0), 10.5),  # missing is below at the first node,
        ((3.0, np.nan), 30.5),  # above at the second
    ],
)
def test_a_tree_is_followed_to_its_leaf(tmp_path, features, expected):
    first, second = sums(tmp_path)
    at = np.array([features], np.float32).T
    assert first.sum_at(at).tolist() == [expected]
    assert second.sum_at(at).tolist() == [7.0]


def test_a_table_that_was_saved_is_the_same(tmp_path):
    saved = sums(tmp_path)
    DecisionTrees.save(tmp_path / "again.tsv", saved)
    loaded = DecisionTrees.load(tmp_path / "again.tsv")
    for before, after in zip(saved, loaded, strict=True):
        for one, other in zip(before, after):
            assert np.array_equal(one, other)
            assert one.dtype == other.dtype


def test_no_pixel_changes_another(tmp_path):
    rng = np.random.default_rng(0)
    features = rng.normal(0.0, 3.0, (2, 1000)).astype(np.float32)
    of, _ = sums(tmp_path)
    whole = of.sum_at(features)
    assert np.array_equal(whole[::7], of.sum_at(features[:, ::7]))
    assert of.sum_at(features[:, :0]).shape == (0,)
