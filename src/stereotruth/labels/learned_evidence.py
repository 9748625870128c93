"""How far what both images tell lies outside of what the probabilities were learned from.

Decision trees answer as surely where nothing like it was ever learned. So the range of each figure
of the evidence lies beside them (bench/change_probability.py), and a scene's summary says how many
of its pixels lie beyond.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bits = NDArray[np.uint32]

ASKED = np.uint32(1)
LEARNED = Path(__file__).with_suffix(".tsv")


@cache
def learned(diachronic: bool) -> Floats:
    """Lowest and greatest value [2, k] of each figure of the evidence that trees are fitted to, but
    for one in a hundred at either end."""
    rows = np.loadtxt(LEARNED, np.float64, delimiter="\t", skiprows=1, usecols=(1, 2, 3))
    return rows[rows[:, 0] == diachronic, 1:].T


def beyond_learned(evidence: Singles, diachronic: bool) -> Bits:
    """Which of the figures of the ``evidence`` [k, n] lie beyond what has been learned [n]: the bit
    ASKED, and from the next one on a bit for each figure."""
    low, high = learned(diachronic)[..., None]
    is_beyond = (evidence < low) | (evidence > high)  # false for NaN
    return ASKED + (np.uint32(2) << np.arange(len(evidence), dtype=np.uint32)) @ is_beyond


def beyond_counts(beyond: Bits) -> NDArray[np.int64]:
    """Of pixels [h, w]: how many were asked, and how many lie beyond by each figure [1 + k]."""
    figures = learned(False).shape[1]
    return np.array([(beyond >> bit & 1).sum(dtype=np.int64) for bit in range(1 + figures)])
