"""Sums of decision trees (gradient boosting, Friedman 2001), as they are kept in a table.

A tree asks one feature after the other and ends in a value; the values of all trees are added in
one order, whatever pixels are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels import kernel

Singles = NDArray[np.float32]
Steps = NDArray[np.int32]
COLUMNS = "sum tree feature limit missing_is_below below above value"
LEAF = -1  # as the feature of a node that asks none


class DecisionTrees(NamedTuple):
    """Nodes of all trees [n], one tree after the other, each from its root.

    ``tree``: number of the node's. A node asks whether ``feature`` is no more than its ``limit``;
    NaN counts as below where ``missing_is_below``. ``below`` and ``above`` are the steps to the
    nodes that come next. A leaf has the feature LEAF, and adds its ``value``.
    """

    tree: Steps
    feature: Steps
    limit: Singles
    missing_is_below: Steps
    below: Steps
    above: Steps
    value: Singles

    @classmethod
    def load(cls, file: Path) -> list[DecisionTrees]:
        """Those of each sum in a table of the columns COLUMNS, tab-separated."""
        of, *columns = np.loadtxt(file, np.float64, delimiter="\t", skiprows=1, unpack=True)
        types = (np.int32, np.int32, np.float32, np.int32, np.int32, np.int32, np.float32)
        typed = [column.astype(kind) for column, kind in zip(columns, types, strict=True)]
        return [cls(*(column[of == number] for column in typed)) for number in np.unique(of)]

    @classmethod
    def save(cls, file: Path, sums: Sequence[DecisionTrees]) -> None:
        """Those of several ``sums`` as a table for :meth:`load`."""
        lines = [COLUMNS.split()]
        for number, of in enumerate(sums):
            lines += [[str(number), *(f"{float(v):.7g}" for v in node)] for node in zip(*of)]
        file.write_text("".join("\t".join(line) + "\n" for line in lines), encoding="utf-8")

    def sum_at(self, features: Singles) -> Singles:
        """Sum of all trees' values [n] at the ``features`` [k, n]."""
        out = np.empty(features.shape[1], np.float32)
        roots = np.flatnonzero(np.diff(self.tree, prepend=-1)).astype(np.int32)
        _sum_at(np.ascontiguousarray(features.T), roots, *self[1:], out)
        return out


@kernel
def _sum_at(
    features: Singles,
    roots: Steps,
    feature: Steps,
    limit: Singles,
    missing_is_below: Steps,
    below: Steps,
    above: Steps,
    value: Singles,
    out: Singles,
) -> None:
    """``features`` [n, k]; ``roots``: first nodes of the trees."""
    for n in range(len(features)):
        total = np.float32(0.0)
        for root in roots:
            node = root
            while feature[node] != LEAF:
                x = features[n, feature[node]]
                is_below = missing_is_below[node] != 0 if np.isnan(x) else x <= limit[node]
                node += below[node] if is_below else above[node]
            total += value[node]
        out[n] = total
