"""A small pair with exact labels: textured sloping ground, a block on it, analytic occlusion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

SIZE = 288
BLOCK = (90, 200, 110, 190)  # left, right, top, bottom: columns and rows of the left image
HEIGHT_PX = 14.0  # disparity of the block above the ground
SLOPE = 0.02


@dataclass
class Scene:
    """Images, labels of what both views see (NaN else), exact disparity of all, hidden pixels."""

    left: np.ndarray
    right: np.ndarray
    labels: np.ndarray
    exact: np.ndarray
    hidden: np.ndarray


def texture(rng, size):
    """Grey values without anything finer than the pixels carry."""
    fine = gaussian_filter(rng.normal(size=(size, size)), 1.4, mode="wrap")
    coarse = gaussian_filter(rng.normal(size=(size, size)), 6.0, mode="wrap")
    return 500 + 90 * fine / fine.std() + 60 * coarse / coarse.std()


def sample(image, x, y):
    return map_coordinates(image, [y + 64, x + 64], order=5, mode="wrap")


def make(seed=0, **options):
    """A scene of its own, to be spoiled, see :func:`made`."""
    found = made(seed, **options)
    return replace(found, **{name: array.copy() for name, array in vars(found).items()})


@cache
def made(seed=0, *, noise=3.0, shift=(0.0, 0.0), tilt=0.0, size=SIZE, offset=0.0, slope=SLOPE):
    """``shift``: the right image's content moves by this much (x, y) against labels and rows.

    ``tilt``: of the rows along x, px from the middle to the edge. ``offset`` of all
    disparities, ``slope`` of the ground's.
    """
    rng = np.random.default_rng(seed)
    ground, roof = texture(rng, size + 128), texture(rng, size + 128) + 150
    y, x = np.mgrid[:size, :size].astype(float)

    def ground_disparity(x_left):
        return offset + slope * (x_left - size / 2)

    first, last, top, bottom = BLOCK
    high = ground_disparity((first + last) / 2) + HEIGHT_PX
    on_roof = (x >= first) & (x < last) & (y >= top) & (y < bottom)
    exact = np.where(on_roof, high, ground_disparity(x))
    left = np.where(on_roof, sample(roof, x, y), sample(ground, x, y))

    x_right = x - shift[0]
    y_right = y - shift[1] - tilt * (2 * x - size) / size
    rows = (y_right >= top - 0.5) & (y_right < bottom - 0.5)
    on_right = rows & (x_right + high >= first - 0.5) & (x_right + high < last - 0.5)
    x_ground = (x_right + offset - slope * size / 2) / (1 - slope)
    right = np.where(
        on_right, sample(roof, x_right + high, y_right), sample(ground, x_ground, y_right)
    )
    wall = (y >= top) & (y < bottom) & ~on_roof & (x < first)
    hidden = wall & (x - exact >= first - high - 0.5)

    images = [
        np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 1, 65535).astype(np.uint16)
        for image in (left, 0.9 * right + 40)
    ]
    labels = np.where(hidden, np.nan, exact).astype(np.float32)
    return Scene(*images, labels, exact.astype(np.float32), hidden)
