"""How far colours are apart, for all eyes: CIE 1976 differences as three kinds of eyes see them.

Protanopia and deuteranopia after Machado, Oliveira and Fernandes, IEEE TVCG 2009, severity 1.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

EYES = {
    "usual": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
) / np.array([[0.9505], [1.0], [1.089]])


def rgb(colour: str) -> tuple[int, ...]:
    """#rrggbb as three numbers."""
    return tuple(bytes.fromhex(colour[1:]))


def lab(colours: ArrayLike, eyes: str = "usual") -> NDArray[np.float64]:
    """L*, a*, b* [n, 3] of sRGB colours [n, 3], 0 … 255."""
    c = np.asarray(colours, float) / 255
    light = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(light @ EYES[eyes].T, 0, 1) @ TO_XYZ.T
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    x, y, z = f.T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


def nearest(colours: ArrayLike) -> float:
    """The least difference of two of the colours, for any eyes."""
    seen = [lab(colours, eyes) for eyes in EYES]
    pairs = combinations(range(len(seen[0])), 2)
    return min(float(np.linalg.norm(s[a] - s[b])) for a, b in pairs for s in seen)
