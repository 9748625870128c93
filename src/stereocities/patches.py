"""Roofs of any shape: a raster of planar patches with vertical sides, which rays meet exactly.

A patch is a square of PATCH_M of the plan, solid from the ground up to a plane of its own. Patches
of one plane make one roof without a seam; between others stand vertical steps.
"""

from __future__ import annotations

import numpy as np

from stereotruth.core.kernels import inlined

PATCH_M = 0.25
PATCHES_A_CELL = 32  # of surfaces.CELL_M, along each side
NOTHING = -1e9  # z where no patch stands
STEP_M = 0.05  # what a ray enters deeper below a patch's top than this is its side


@inlined
def patch_top(s, i, j, ax, ay, bx, by, low, high):
    """Where a ray from above first meets a patch of cell (i, j) between two heights.

    Returns z (−1e30: nowhere), number of the patch in the raster and whether its side is met.
    ``low``, ``high``: z where the ray enters and leaves the cell, from below.
    """
    top, number, is_side = -1e30, -1, False
    rows, cols = s.patches.shape[0], s.patches.shape[1]
    first_i, first_j = PATCHES_A_CELL * (i - s.patch_i), PATCHES_A_CELL * (j - s.patch_j)
    if first_i < 0 or first_j < 0 or first_i >= cols or first_j >= rows:
        return top, number, is_side
    last_i, last_j = first_i + PATCHES_A_CELL - 1, first_j + PATCHES_A_CELL - 1
    x0 = s.x0 + PATCHES_A_CELL * PATCH_M * s.patch_i
    y0 = s.y0 + PATCHES_A_CELL * PATCH_M * s.patch_j
    m = min(max(int((ax + bx * low - x0) / PATCH_M), first_i), last_i)
    n = min(max(int((ay + by * low - y0) / PATCH_M), first_j), last_j)
    step_m, step_n = 1 if bx > 0 else -1, 1 if by > 0 else -1
    next_x = next_y = per_x = per_y = 1e30
    if abs(bx) > 1e-9:
        next_x, per_x = (x0 + PATCH_M * (m + (bx > 0)) - ax) / bx, PATCH_M / abs(bx)
    if abs(by) > 1e-9:
        next_y, per_y = (y0 + PATCH_M * (n + (by > 0)) - ay) / by, PATCH_M / abs(by)
    z = low
    while z < high:
        leaves = min(next_x, next_y, high)
        middle = s.patches[n, m, 0]
        if middle > NOTHING:
            # height above the patch's plane is rate z - level
            gx, gy = s.patches[n, m, 1], s.patches[n, m, 2]
            rate = 1 - gx * bx - gy * by
            level = middle + gx * (ax - x0 - PATCH_M * (m + 0.5))
            level += gy * (ay - y0 - PATCH_M * (n + 0.5))
            above = rate * leaves - level
            if above < 0:
                top, number, is_side = leaves, n * cols + m, above < -STEP_M
            elif rate * z - level < 0:
                top, number, is_side = level / rate, n * cols + m, False
        z = leaves
        if next_x < next_y:
            next_x += per_x
            m += step_m
        else:
            next_y += per_y
            n += step_n
        if m < first_i or n < first_j or m > last_i or n > last_j:
            break
    return top, number, is_side


def greatest(patches: np.ndarray) -> np.ndarray:
    """Greatest z of each patch, [rows, cols]."""
    slopes = np.abs(patches[..., 1]) + np.abs(patches[..., 2])
    return patches[..., 0] + PATCH_M / 2 * slopes
