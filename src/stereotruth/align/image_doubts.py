"""What is odd about an image beside the others of its site, by the figures of the adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from .refine import MIN_USED

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Figures = Mapping[str, Mapping[str, Any]]

HEAVY = 0.1  # weight of a pair that is left out, or nearly so
CHANCE = 0.05  # that a site without a fault has an image that stands out
FEWEST = 4  # values of a test: if two of three are alike, the third is always an outlier
MOST_OUT = 0.25  # share of the images that may stand out
NORMAL = 2.0 / 3.0  # power of a length that is normal if both coordinates are (Wilson, Hilferty)
LEAST_SPREAD_PX = 0.3  # px to that power, of corrections: less makes none of them stand out
LEAST_SPREAD_SHARE = 0.1  # of the shares that match, likewise


def stand_out(values: Floats, least_spread: float) -> Bools:
    """Which of n values are too large for the others, by the generalised extreme deviate test.

    Rosner 1983: the largest value is held against mean and standard deviation (``least_spread`` at
    least), then the largest of the others, and so on; all up to the last one that Student's t makes
    too unlikely stand out, so that two of them do not hide each other.
    """
    order = np.argsort(values)[::-1]
    count = 0
    for k in range(max(1, int(MOST_OUT * len(values)))):
        rest = values[order[k:]]
        n = len(rest)
        if n < FEWEST:
            break
        t = stdtrit(n - 2, 1.0 - CHANCE / n)
        limit = (n - 1) * t / np.sqrt((n - 2 + t**2) * n)
        spread = max(float(rest.std(ddof=1)), least_spread)
        if rest[0] - rest.mean() > limit * spread:
            count = k + 1
    out = np.zeros(len(values), bool)
    out[order[:count]] = True
    return out


def _named(values: Mapping[str, float], sign: float, least_spread: float) -> set[str]:
    """The names whose values, times ``sign``, are too large for the others."""
    out = stand_out(sign * np.array(list(values.values())), least_spread)
    return {name for name, is_out in zip(values, out) if is_out}


def image_doubts(images: Figures, pairs: Figures) -> dict[str, list[str]]:
    """The doubts of each image by name; ``images``, ``pairs``: figures of the adjustment."""
    own = {
        name: [pair for pair in pairs.values() if name in (pair["left"], pair["right"])]
        for name in images
    }
    placed = [name for name, image in images.items() if not image["refused"]]
    lengths = {
        name: float(np.hypot(images[name]["correction"]["col"], images[name]["correction"]["row"]))
        for name in placed
    }
    far = _named({name: v**NORMAL for name, v in lengths.items()}, 1.0, LEAST_SPREAD_PX)
    # A pair matches no better than the poorer of its images: the best pair tells of both.
    shares = {
        name: max(pair["matched"] for pair in own[name])
        for name in placed
        if any(pair["tie_points"] for pair in own[name])
    }
    usual, usual_share = (
        float(np.median(list(values.values()))) if values else 0.0 for values in (lengths, shares)
    )
    poor = _named(shares, -1.0, LEAST_SPREAD_SHARE)
    poor |= {name for name, share in shares.items() if share < MIN_USED * usual_share}
    doubts: dict[str, list[str]] = {}
    for name, image in images.items():
        texts = doubts.setdefault(name, [])
        gcps, count = image["gcps"], len(own[name])
        if image["refused"]:
            texts.append(image["refused"])
            continue
        if name in far and not image["fixed"]:
            texts.append(
                f"its RPC is off by {lengths[name]:.1f} px, where {usual:.1f} px are usual here; "
                "corrected"
            )
        if name not in shares:
            reasons = "; ".join(sorted({pair["reason"] for pair in own[name]}))
            texts.append(f"no tie points in any of its pairs ({count}): {reasons}")
        elif name in poor:
            texts.append(
                f"of the places compared in its pairs {100 * shares[name]:.0f} % match at best, "
                f"where {100 * usual_share:.0f} % are usual here: clouds, or another ground?"
            )
        light = sum(pair.get("weight", 1.0) < HEAVY for pair in own[name])
        if light > count / 2:
            texts.append(
                f"the tie points of {light} of its {count} pairs contradict the other images"
            )
        if gcps["left_out"]:
            texts.append(
                f"control points left out, which fit no correction: {', '.join(gcps['left_out'])}"
            )
    return doubts
