"""The surface of a tile's labels: a hillshade, and the grid that the page's 3-D view draws."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..products.pictures import NO_VALUE, Picture

SUN = np.array([-1.0, -1.0, math.sqrt(2.0)]) / 2.0  # from the top left, 45 degrees high
TOP = 255  # of the values of a grid; 0 is no label


@dataclass(frozen=True)
class Relief:
    """Heights of a tile, for the page.

    ``values``: base64 of uint8[side, side], 0 without a label, else 1 at the lowest label to 255 at
    the highest. ``height``: between these two, in widths of the tile.
    """

    values: str
    side: int
    height: float

    @classmethod
    def of(cls, disparity: NDArray[np.floating], base_to_height: float, side: int) -> Relief:
        """Of disparity[rows, cols] in px, NaN without a label, at ``side`` places along each axis.

        Labels beyond the permille at either end are drawn there.
        """
        rows, cols = (np.linspace(0, n - 1, side).round().astype(int) for n in disparity.shape)
        known = np.isfinite(disparity)
        low, high = (float(v) for v in np.percentile(disparity[known], (0.1, 99.9)))
        span = max(high - low, 1e-6)
        share = np.clip((np.nan_to_num(disparity[np.ix_(rows, cols)]) - low) / span, 0.0, 1.0)
        values = np.where(known[np.ix_(rows, cols)], np.rint(1 + (TOP - 1) * share), 0)
        text = base64.b64encode(values.astype(np.uint8).tobytes()).decode("ascii")
        return cls(text, side, (high - low) / base_to_height / disparity.shape[1])


def hillshade(disparity: NDArray[np.floating], base_to_height: float) -> Picture:
    """Lambert's shading uint8[h, w, 3] of disparity[h, w] in px as heights in px of the ground.

    The sun stands at the top left, 45 degrees high. Light grey where a slope is not known.
    """
    height = np.asarray(disparity, np.float64) / base_to_height
    down, right = np.gradient(height)
    normal = np.stack([-right, -down, np.ones_like(height)])
    light = np.tensordot(SUN, normal, 1) / np.linalg.norm(normal, axis=0)
    known = np.isfinite(light) & np.isfinite(height)
    grey = np.rint(255 * np.clip(np.where(known, light, 0.0), 0.0, 1.0)).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    picture[~known] = NO_VALUE
    return picture
