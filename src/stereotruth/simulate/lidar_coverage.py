"""Where a scene has LiDAR: beyond its image on two sides, ending inside it on the others."""

from __future__ import annotations

import math

import numpy as np

from ..kernels import inlined
from .cities import CitySpec, SceneSpec
from .layout import half_size, image_axes


def coverage(city: CitySpec, scene: SceneSpec) -> np.ndarray:
    """Packed outline float64[21] of a scene's LiDAR coverage, see :func:`covered`.

    It reaches beyond the image at the first columns and last rows, and ends inside it, raggedly,
    at the last columns and first rows, with a block missing in the corner between them. That of a
    twin is a rectangle.
    """
    if city.twin is not None:  # what the file covers, and not the image's margin around it
        cos, sin = math.cos(city.twin.turned_rad), math.sin(city.twin.turned_rad)
        outline = [0.0, 0.0, cos, sin, -sin, cos, *city.twin.half_m]
        return np.array([*outline, *np.zeros(13)])
    across, along = image_axes(city, scene)
    rng = np.random.default_rng([scene.pose_seed, 6])
    beyond = 35.0 + 0.12 * city.character.relief_m
    return np.array([
        *scene.centre_m, *across, *along, *half_size(scene), beyond, *scene.ragged_m,
        *rng.uniform(0, 2 * np.pi, 6), *scene.gap_m, *rng.uniform(0, 2 * np.pi, 2),
    ])  # fmt: skip


@inlined
def covered(c, x, y):
    """Whether a plan position lies in the LiDAR coverage."""
    dx, dy = x - c[0], y - c[1]
    a, b = dx * c[2] + dy * c[3], dx * c[4] + dy * c[5]
    if a < -c[6] - c[8] or b > c[7] + c[8]:
        return False
    # the waves below stay within these factors: most points need no sine
    if a < c[6] - 1.95 * c[9] and b > -c[7] + 1.95 * c[10]:
        inside = True
    else:
        edge_a = 1 + 0.5 * math.sin(b / 150 + c[11]) + 0.3 * math.sin(b / 61 + c[12])
        edge_a += 0.15 * math.sin(b / 19 + c[13])
        edge_b = 1 + 0.5 * math.sin(a / 170 + c[14]) + 0.3 * math.sin(a / 53 + c[15])
        edge_b += 0.15 * math.sin(a / 17 + c[16])
        inside = a <= c[6] - c[9] * edge_a and b >= -c[7] + c[10] * edge_b
    if not inside or a < c[6] - 1.07 * c[17] or b > -c[7] + 1.07 * c[18]:
        return inside
    gap_a = c[17] * (1 + 0.05 * math.sin(b / 90 + c[19]) + 0.02 * math.sin(b / 23))
    gap_b = c[18] * (1 + 0.05 * math.sin(a / 80 + c[20]) + 0.02 * math.sin(a / 21))
    return a < c[6] - gap_a or b > -c[7] + gap_b
