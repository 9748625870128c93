"""Sums of decision trees (gradient boosting, Friedman 2001), as they are kept in a table.

A tree asks one feature after the other and ends in a value; the values of all trees are added in
one order, whatever pixels are asked for.

Not one pixel after the other goes down a tree, whose branches a processor cannot foresee: each node
is asked for many pixels at once, and takes from those above its limit the leaves below it. Of the
leaves that a pixel keeps the first is its own (QuickScorer, Lucchese et al. 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.arrays import Singles

Steps = NDArray[np.int32]
TREE_COLUMNS = "sum tree feature limit missing_is_below above value"
LEAF = -1  # as the feature of a node that asks none
MOST_LEAVES = 31  # of a tree: bits of a whole number
PIXELS_AT_ONCE = 256  # pixels that are asked at once


class DecisionTrees(NamedTuple):
    """Nodes of all trees [n], one tree after the other, each from its root.

    ``tree``: number of the node's. A node asks whether ``feature`` is no more than its ``limit``;
    NaN counts as below where ``missing_is_below``. The next node begins the part of the tree that
    is below; ``above`` steps on, after the last node of that part, the other one begins. A leaf has
    the feature LEAF, and adds its ``value``.
    """

    tree: Steps
    feature: Steps
    limit: Singles
    missing_is_below: Steps
    above: Steps
    value: Singles

    @classmethod
    def load(cls, file: Path) -> list[DecisionTrees]:
        """Those of each sum in a table of the columns TREE_COLUMNS, tab-separated."""
        sum_of_tree, *columns = np.loadtxt(
            file, np.float64, delimiter="\t", skiprows=1, unpack=True
        )
        types = (np.int32, np.int32, np.float32, np.int32, np.int32, np.float32)
        typed = [column.astype(kind) for column, kind in zip(columns, types, strict=True)]
        return [
            cls(*(column[sum_of_tree == number] for column in typed))
            for number in np.unique(sum_of_tree)
        ]

    @classmethod
    def save(cls, file: Path, sums: Sequence[DecisionTrees]) -> None:
        """Those of several ``sums`` as a table for :meth:`load`."""
        lines = [TREE_COLUMNS.split()]
        for number, trees in enumerate(sums):
            lines += [[str(number), *(f"{float(v):.7g}" for v in node)] for node in zip(*trees)]
        file.write_text("".join("\t".join(line) + "\n" for line in lines), encoding="utf-8")

    def sum_at(self, features: Singles) -> Singles:
        """Sum of all trees' values [n] at the ``features`` [k, n].

        Raises ValueError for a tree of more than MOST_LEAVES leaves.
        """
        is_leaf = self.feature == LEAF
        ends = np.append(np.flatnonzero(np.diff(self.tree, prepend=-1)), self.tree.size)
        met = np.concatenate([[0], np.cumsum(is_leaf)])  # leaves before each node, of all trees
        most = int(np.diff(met[ends]).max())
        if most > MOST_LEAVES:
            raise ValueError(f"a tree has {most} leaves, more than {MOST_LEAVES}")
        number = np.repeat(np.arange(ends.size - 1), np.diff(ends))
        first = met[:-1] - met[ends[number]]
        end = met[np.arange(self.tree.size) + self.above] - met[ends[number]]
        kept = (~((1 << end) - (1 << first))).astype(np.int32)
        values = np.zeros((ends.size - 1, most), np.float32)
        values[number[is_leaf], first[is_leaf]] = self.value[is_leaf]
        out = np.empty(features.shape[1], np.float32)
        asked = self.feature, self.limit, self.missing_is_below
        _sum_at(np.ascontiguousarray(features), ends, *asked, kept, values, out)
        return out


@kernel
def _sum_at(
    features: Singles,
    ends: NDArray[np.int64],
    feature: Steps,
    limit: Singles,
    missing_is_below: Steps,
    kept: Steps,
    values: Singles,
    out: Singles,
) -> None:
    """``ends`` [trees + 1]: first nodes of the trees, and the number of all nodes; ``kept``
    [nodes]: the leaves (bits) of a tree that are not below a node; ``values`` [trees, leaves]."""
    leaves, answer = np.empty(PIXELS_AT_ONCE, np.int32), np.empty(PIXELS_AT_ONCE, np.float32)
    every, last = np.int32(-1), values.shape[1] - 1
    for start in range(0, features.shape[1], PIXELS_AT_ONCE):
        total = out[start : start + PIXELS_AT_ONCE]
        total[:] = np.float32(0.0)
        size = total.size
        for tree in range(len(values)):
            leaves[:] = every
            for node in range(ends[tree], ends[tree + 1]):
                if feature[node] == LEAF:
                    continue
                x, most, others = features[feature[node], start:], limit[node], kept[node]
                if missing_is_below[node] != 0:
                    for k in range(size):
                        leaves[k] &= others if x[k] > most else every
                else:
                    for k in range(size):
                        leaves[k] &= every if x[k] <= most else others
            answer[:] = values[tree, last]
            for leaf in range(last - 1, -1, -1):
                bit, value = np.int32(1 << leaf), values[tree, leaf]
                for k in range(size):
                    answer[k] = value if leaves[k] & bit != 0 else answer[k]
            for k in range(size):
                total[k] += answer[k]
