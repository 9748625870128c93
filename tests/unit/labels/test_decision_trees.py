"""Sums of decision trees, against small ones that are followed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereotruth.labels.decision_trees import TREE_COLUMNS, DecisionTrees

TWO_TREES = """\
0	0	-1	0	0	0	0.5
0	1	0	2	1	2	0
0	1	-1	0	0	0	10
0	1	1	-1	0	2	0
0	1	-1	0	0	0	20
0	1	-1	0	0	0	30
1	0	-1	0	0	0	7
"""


def sums(folder: Path) -> list[DecisionTrees]:
    file = folder / "trees.tsv"
    file.write_text(TREE_COLUMNS.replace(" ", "\t") + "\n" + TWO_TREES)
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
    for before, after in zip(saved, DecisionTrees.load(tmp_path / "again.tsv"), strict=True):
        assert all(np.array_equal(one, other) for one, other in zip(before, after))


def grown(rng: np.random.Generator, leaves: int) -> list[tuple[int, float, int, int, float]]:
    """Nodes of a tree of so many ``leaves``: feature, limit, missing_is_below, above, value."""
    if leaves == 1:
        return [(-1, 0.0, 0, 0, float(rng.normal()))]
    left = int(rng.integers(1, leaves))
    below, above = grown(rng, left), grown(rng, leaves - left)
    asked = int(rng.integers(0, 3)), float(rng.normal()), int(rng.integers(0, 2))
    return [(*asked, len(below) + 1, 0.0), *below, *above]


def trees_of(leaves: list[int]) -> DecisionTrees:
    """Drawn trees, of so many leaves each."""
    rng = np.random.default_rng(len(leaves))
    rows = [(n, *node) for n, most in enumerate(leaves) for node in grown(rng, most)]
    types = np.int32, np.int32, np.float32, np.int32, np.int32, np.float32
    return DecisionTrees(*(np.array(column, kind) for column, kind in zip(zip(*rows), types)))


def followed(of: DecisionTrees, pixel: np.ndarray) -> np.float32:
    """The sum at one pixel, down one tree after the other."""
    total = np.float32(0.0)
    for number in np.unique(of.tree):
        node = int(np.flatnonzero(of.tree == number)[0])
        while of.feature[node] >= 0:
            x = pixel[of.feature[node]]
            below = of.missing_is_below[node] if np.isnan(x) else x <= of.limit[node]
            node += 1 if below else int(of.above[node])
        total += of.value[node]
    return total


def test_trees_of_any_form_are_followed() -> None:
    of = trees_of([1, 2, 3, 16, 5, 31, 16, 30])
    features = np.random.default_rng(1).normal(size=(3, 700)).astype(np.float32)
    features[np.random.default_rng(2).uniform(size=features.shape) < 0.1] = np.nan
    expected = [followed(of, pixel) for pixel in features.T]
    assert of.sum_at(features).tolist() == expected
    assert of.sum_at(features[:, ::7]).tolist() == expected[::7]


def test_a_tree_of_too_many_leaves_is_refused() -> None:
    with pytest.raises(ValueError, match="32 leaves"):
        trees_of([4, 32]).sum_at(np.zeros((3, 1), np.float32))
