"""One adjustment of all strips of a LiDAR that were compared by pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from .strip_offsets import Strip, StripKey, StripOffsets
from .strip_planes import Offset

Floats = NDArray[np.float64]

FALSE_REMARK = 0.01  # probability that strips of a site without offsets are named
SYSTEMATIC_M = (0.03, 0.03, 0.005)  # east, north, up: what pairs of strips that agree differ by


class Compared(NamedTuple):
    """Two strips by name, and the offset of the second from the first."""

    first: str
    second: str
    offset: Offset


class Flown(NamedTuple):
    """A strip: its name, the key of its points and the ground that they cover (m²)."""

    name: str
    key: StripKey
    ground_m2: float


def adjusted_offsets(
    strips: Sequence[Flown],
    compared: Sequence[Compared],
    shares: NDArray[np.void],
) -> StripOffsets:
    """Offsets of ``strips`` (most ground first) from the first, by least squares.

    Strips that no chain of overlaps ties to the first count from the one with most ground among
    those that they are tied to. Offsets are named where chance explains them too seldom
    (:data:`FALSE_REMARK` for all strips together). ``shares``: see :class:`.StripOffsets`.
    """
    names = [strip.name for strip in strips]
    index = {name: k for k, name in enumerate(names)}
    group = list(range(len(names)))  # the first strip that each is tied to
    for _ in names:
        for a, b, _ in compared:
            low = min(group[index[a]], group[index[b]])
            group[index[a]] = group[index[b]] = low
    size = 3 * len(names)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for a, b, offset in compared:
        at = [slice(3 * index[name], 3 * index[name] + 3) for name in (a, b)]
        weight = np.linalg.inv(offset.covariance + np.diag(np.square(SYSTEMATIC_M)))
        for one, sign in zip(at, (-1.0, 1.0)):
            right[one] += sign * weight @ offset.value
            for other, against in zip(at, (-1.0, 1.0)):
                normal[one, other] += sign * against * weight
    free = np.repeat([group[k] != k for k in range(len(names))], 3)
    value, covariance = np.zeros(size), np.zeros((size, size))
    if free.any():
        inverse = np.linalg.inv(normal[np.ix_(free, free)])
        value[free] = inverse @ right[free]
        misfit, redundancy = 0.0, 3 * len(compared) - int(free.sum())
        for a, b, offset in compared:
            of = value.reshape(-1, 3)
            rest = offset.value - of[index[b]] + of[index[a]]
            weight = np.linalg.inv(offset.covariance + np.diag(np.square(SYSTEMATIC_M)))
            misfit += float(rest @ weight @ rest)
        covariance[np.ix_(free, free)] = inverse * max(misfit / max(redundancy, 1), 1.0)
    tests = max(sum(group[k] != k for k in range(len(names))), 1)
    found = []
    for k, strip in enumerate(strips):
        own = slice(3 * k, 3 * k + 3)
        tied = group[k] != k
        chance = 1.0
        if tied:
            statistic = value[own] @ np.linalg.solve(covariance[own, own], value[own])
            fewest = min(c.offset.groups for c in compared if strip.name in c[:2])
            chance = min(1.0, float(fdtrc(3, fewest - 3, statistic / 3)) * tests)
        found.append(
            Strip(
                *strip,
                names[group[k]] if tied or k in group[:k] + group[k + 1 :] else "",
                tuple(value[own].round(4).tolist()),
                tuple(map(tuple, covariance[own, own].round(10).tolist())),
                0.0 if math.isnan(chance) else float(f"{chance:.3g}"),
                tied and chance < FALSE_REMARK,
            )
        )
    return StripOffsets(tuple(found), shares)
