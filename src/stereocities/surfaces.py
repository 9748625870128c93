"""Exact ray casting on the surfaces of a synthetic city.

Ground is a bicubic B-spline of z over (x, y), cut by a level water plane. Buildings are rotated
rectangles with vertical walls and a flat or gabled roof, closed below; trees are ellipsoids. Twins
of real places have a raster of planar patches in the place of buildings: a patch is a square of
PATCH_M of the plan, solid from the ground up to a plane of its own. Patches of one plane make one
roof without a seam; between others stand vertical steps.

Rays are lines x = ax + bx z, y = ay + by z, given by (ax, ay, bx, by), and all of them come from
above everything: the surface that is hit is the one of greatest z. The cell lists only say which
objects a ray may meet; the intersections are those of the surfaces themselves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereotruth.core.kernels import inlined, kernel

PATCH_M = 0.25
PATCHES_A_CELL = 32  # of CELL_M, along each side
NOTHING = -1e9  # z where no patch stands
STEP_M = 0.05  # what a ray enters deeper below a patch's top than this is its side

NONE, GROUND, ROOF, WALL, TREE, WATER = range(6)
IN_IMAGES, IN_LIDAR, IN_LEFT, IN_RIGHT = 1, 2, 4, 8  # where an object is: bits
LEFT_VIEW, RIGHT_VIEW = IN_IMAGES | IN_LEFT, IN_IMAGES | IN_RIGHT  # bits that an image shows
ANY_VIEW = LEFT_VIEW | RIGHT_VIEW
FIRST_PATCH = -2  # object number of patch 0; patch n has FIRST_PATCH - n
CELL_M = 8.0
REACH_CELLS = 16  # no object is so high that a ray passes over more cells beside it
SAME_M = 0.01  # off a patch's plane: of the same roof
CLOSE_M = 1e-3  # a step of Newton's method below which the next, its square, is none
LIDAR_LEAN = 0.27  # greatest tangent of a LiDAR pulse off the vertical


@inlined
def patch_top(s, i, j, ax, ay, bx, by, low, high):
    """z where a ray from above first meets a patch of cell (i, j) between two heights, −1e30:
    nowhere; number of the patch in the raster; whether its side is met.

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


class Surfaces(NamedTuple):
    """All that the kernels know of a city.

    ``x0``, ``y0``: lower corner of terrain and cells (m). ``terrain`` float64[ny, nx]: spline
    coefficients, ``step`` m apart. ``boxes`` float64[n, 8]: centre x, y, long axis ux, uy, half
    length, half width, z of the eaves, rise of the ridge. ``box_view``, ``tree_view`` uint8[n]:
    bits of IN_IMAGES (both), IN_LIDAR, IN_LEFT, IN_RIGHT. ``box_style`` float64[n, 4]: albedo of
    roof, of walls, kind of roof cover, phase. ``trees`` float64[n, 6]: x, y, z of the centre,
    radius, half height, square of their ratio.
    ``tree_style`` float64[n, 2]: factor on the reflectance, share of the pulses that pass.
    ``ground_look`` float64[2]: factors on the ground's reflectance and on its contrast.
    ``*_first``/``*_list``: objects by cell. ``cell_top`` float32[ny, nx]: greatest z of an object
    in the cell. ``sun_top`` and ``lidar_top``: :func:`horizon` toward the sun and of LiDAR pulses.
    ``zones``, ``zone_cells``, ``zone_near``: see :func:`.layout.draw_zones`. ``resurfaced``: share
    of the streets that have another texture.
    ``patches`` float32[rows, cols, 3]: z in the middle and slopes along x and y of the patches,
    from cell (``patch_i``, ``patch_j``) on; ``patch_side`` uint8[rows, cols]:
    direction in which their sides look, counter-clockwise from east, in 256 parts of a turn.
    ``patch_building`` int32[rows, cols]: the building that a patch is part of, −1 for none.
    ``paint`` uint16[rows, cols]: reflectance of ground and roofs there, in parts of PAINT. A drawn
    city has none of them.
    """

    x0: float
    y0: float
    step: float
    terrain: np.ndarray
    water: float
    boxes: np.ndarray
    box_view: np.ndarray
    box_style: np.ndarray
    trees: np.ndarray
    tree_view: np.ndarray
    tree_style: np.ndarray
    ground_look: np.ndarray
    box_first: np.ndarray
    box_list: np.ndarray
    tree_first: np.ndarray
    tree_list: np.ndarray
    cell_top: np.ndarray
    sun_top: np.ndarray
    lidar_top: np.ndarray
    zones: np.ndarray
    zone_cells: np.ndarray
    zone_near: np.ndarray
    fine: np.ndarray
    broad: np.ndarray
    sun: np.ndarray
    resurfaced: float
    patches: np.ndarray
    patch_side: np.ndarray
    patch_building: np.ndarray
    patch_i: int
    patch_j: int
    paint: np.ndarray


class Objects(NamedTuple):
    """Boxes or crowns, the bits of their views, and their style, as in :class:`Surfaces`."""

    shapes: np.ndarray
    view: np.ndarray
    style: np.ndarray


def join(*objects: Objects) -> Objects:
    """All objects, one after the other."""
    return Objects(*map(np.concatenate, zip(*objects)))


def direction_of_sun(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit vector [3] toward the sun: east, north, up."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    return np.array([
        math.cos(elevation) * math.sin(azimuth), math.cos(elevation) * math.cos(azimuth),
        math.sin(elevation),
    ])  # fmt: skip


@inlined
def _dot(a, c, j, i):
    """Product with four coefficients of a row."""
    return (
        a[0] * c[j, i]
        + a[1] * c[j, i + np.uint64(1)]
        + a[2] * c[j, i + np.uint64(2)]
        + a[3] * c[j, i + np.uint64(3)]
    )


@inlined
def terrain_at(s, x, y):
    """Terrain z and its derivatives along x and y.

    From six times the spline's weights and twice their derivatives: a division each would be half
    of the time.
    """
    c = s.terrain
    per_step = 1 / s.step
    u, v = (x - s.x0) * per_step, (y - s.y0) * per_step
    i = min(max(int(np.floor(u)), 1), c.shape[1] - 3)
    j = min(max(int(np.floor(v)), 1), c.shape[0] - 3)
    f, g = u - i, v - j
    f1, g1 = 1 - f, 1 - g
    a = f1 * f1 * f1, 4 + f * f * (3 * f - 6), 4 + f1 * f1 * (3 * f1 - 6), f * f * f
    d = -f1 * f1, f * (3 * f - 4), f1 * (4 - 3 * f1), f * f
    b0, b1 = g1 * g1 * g1, 4 + g * g * (3 * g - 6)
    b2, b3 = 4 + g1 * g1 * (3 * g1 - 6), g * g * g
    e0, e1 = -g1 * g1, g * (3 * g - 4)
    e2, e3 = g1 * (4 - 3 * g1), g * g
    # unsigned: signed indices are tested for wrapping around, at half the cost of the spline
    i0, j0 = np.uint64(i - 1), np.uint64(j - 1)
    j1, j2, j3 = np.uint64(j), np.uint64(j + 1), np.uint64(j + 2)
    r0, r1, r2, r3 = _dot(a, c, j0, i0), _dot(a, c, j1, i0), _dot(a, c, j2, i0), _dot(a, c, j3, i0)
    q0, q1, q2, q3 = _dot(d, c, j0, i0), _dot(d, c, j1, i0), _dot(d, c, j2, i0), _dot(d, c, j3, i0)
    z = b0 * r0 + b1 * r1 + b2 * r2 + b3 * r3
    zx = b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3
    zy = e0 * r0 + e1 * r1 + e2 * r2 + e3 * r3
    return z * (1 / 36), zx * (per_step / 12), zy * (per_step / 12)


@inlined
def ground_hit(s, ax, ay, bx, by, guess):
    """(z, z along x, z along y) of the terrain under a ray.

    One solution: no slope reaches the steepness of a ray, so Newton's method has one root to find.
    """
    z, zx, zy = guess, 0.0, 0.0
    for _ in range(25):
        t, zx, zy = terrain_at(s, ax + bx * z, ay + by * z)
        step = (t - z) / (1 - zx * bx - zy * by)
        z += step
        if abs(step) < CLOSE_M:
            break
    return z, zx, zy


@inlined
def box_span(boxes, n, ax, ay, bx, by):
    """(lowest, highest, face) z of a ray inside a building; empty if lowest > highest.

    Faces: 0 and 1 the roof (its two sides), 2 to 5 the walls at +u, −u, +v, −v.
    """
    ux, uy, a, b = boxes[n, 2], boxes[n, 3], boxes[n, 4], boxes[n, 5]
    x, y = ax - boxes[n, 0], ay - boxes[n, 1]
    u0, ub = x * ux + y * uy, bx * ux + by * uy
    v0, vb = y * ux - x * uy, by * ux - bx * uy
    low, high, face = -1e30, 1e30, 0
    if ub > 1e-12 or ub < -1e-12:
        z1, z2 = (-a - u0) / ub, (a - u0) / ub
        if z1 < z2:
            low, high, face = z1, z2, 2
        else:
            low, high, face = z2, z1, 3
    elif abs(u0) > a:
        return 1.0, 0.0, 0
    if vb > 1e-12 or vb < -1e-12:
        z1, z2 = (-b - v0) / vb, (b - v0) / vb
        f = 4
        if z1 > z2:
            z1, z2, f = z2, z1, 5
        if z1 > low:
            low = z1
        if z2 < high:
            high, face = z2, f
    elif abs(v0) > b:
        return 1.0, 0.0, 0
    if boxes[n, 7] == 0.0:
        if boxes[n, 6] < high:
            high, face = boxes[n, 6], 0
    else:  # two roof planes that meet in the ridge over v = 0
        k = boxes[n, 7] / b
        z1 = (boxes[n, 6] + boxes[n, 7] - k * v0) / (1 + k * vb)
        z2 = (boxes[n, 6] + boxes[n, 7] + k * v0) / (1 - k * vb)
        if z1 < high:
            high, face = z1, 0
        if z2 < high:
            high, face = z2, 1
    return low, high, face


@inlined
def tree_top(trees, n, ax, ay, bx, by):
    """Highest z of a ray inside a crown, or −1e30."""
    r2 = trees[n, 3] * trees[n, 3]
    q = trees[n, 5]
    x, y = ax + bx * trees[n, 2] - trees[n, 0], ay + by * trees[n, 2] - trees[n, 1]
    a = bx * bx + by * by + q
    b = x * bx + y * by
    c = x * x + y * y - r2
    root = b * b - a * c
    if root <= 0:
        return -1e30
    return trees[n, 2] + (-b + math.sqrt(root)) / a


@inlined
def cast(s, horizon, ax, ay, bx, by, view, trees, guess):
    """First surface on a ray from above: z, kind, object, face; of the ground z and its slopes.

    ``view``: bits of the objects seen, as LEFT_VIEW or IN_LIDAR. ``trees``: whether crowns stop
    the ray. ``horizon``: what :func:`horizon` gives for such rays. ``guess``: z near which the
    ground is sought.
    """
    ground, zx, zy = ground_hit(s, ax, ay, bx, by, guess)
    best, kind, index, face = above_ground(s, horizon, ax, ay, bx, by, view, trees, ground)
    return best, kind, index, face, ground, zx, zy


@inlined
def above_ground(s, horizon, ax, ay, bx, by, view, trees, ground):
    """z, kind, object, face of the first surface on a ray that meets the ground at z ``ground``."""
    best, kind, index, face = ground, GROUND, -1, 0
    if best < s.water:
        best, kind = s.water, WATER
    x, y = ax + bx * best, ay + by * best
    ny, nx = s.cell_top.shape
    i, j = int((x - s.x0) / CELL_M), int((y - s.y0) / CELL_M)
    if i < 0 or j < 0 or i >= nx or j >= ny:
        return best, NONE, index, face
    z = best
    if z >= horizon[j, i]:
        return best, kind, index, face
    # cells upward along the ray; the next border is crossed at next_x or next_y
    forward_x, forward_y = bx > 0, by > 0
    step_x, step_y = 1 if forward_x else -1, 1 if forward_y else -1
    inverse_x = 1 / bx if abs(bx) > 1e-9 else 1e30
    inverse_y = 1 / by if abs(by) > 1e-9 else 1e30
    per_x, per_y = CELL_M * abs(inverse_x), CELL_M * abs(inverse_y)
    next_x = next_y = 1e30
    if per_x < 1e29:
        next_x = (s.x0 + CELL_M * (i + forward_x) - ax) * inverse_x
    if per_y < 1e29:
        next_y = (s.y0 + CELL_M * (j + forward_y) - ay) * inverse_y
    while z < horizon[j, i]:
        if s.cell_top[j, i] > z:
            cell = j * nx + i
            for n in range(s.box_first[cell], s.box_first[cell + 1]):
                k = s.box_list[n]
                if s.box_view[k] & view and s.boxes[k, 6] + s.boxes[k, 7] > best:
                    low, high, f = box_span(s.boxes, k, ax, ay, bx, by)
                    if high >= low and high > best:
                        best, index, face = high, k, f
                        kind = ROOF if f < 2 else WALL
            if trees:
                for n in range(s.tree_first[cell], s.tree_first[cell + 1]):
                    k = s.tree_list[n]
                    if s.tree_view[k] & view and s.trees[k, 2] + s.trees[k, 4] > best:
                        high = tree_top(s.trees, k, ax, ay, bx, by)
                        if high > best:
                            best, kind, index, face = high, TREE, k, 0
            if s.patches.shape[0] > 0:
                leaves = min(next_x, next_y, s.cell_top[j, i])
                high, k, is_side = patch_top(s, i, j, ax, ay, bx, by, z, leaves)
                if high > best:
                    best, index, face = high, FIRST_PATCH - k, 0
                    kind = WALL if is_side else ROOF
        if next_x < next_y:
            z = next_x
            next_x += per_x
            i += step_x
        else:
            z = next_y
            next_y += per_y
            j += step_y
        if i < 0 or j < 0 or i >= nx or j >= ny:
            break
    return best, kind, index, face


@inlined
def stands_in(s, kind, index, view, z):
    """Whether the object of a surface point at height z is in a view of a world, where something
    may hide it."""
    if kind in (ROOF, WALL) and index <= FIRST_PATCH:
        number = FIRST_PATCH - index
        n, m = number // s.patches.shape[1], number % s.patches.shape[1]
        slopes = abs(s.patches[n, m, 1]) + abs(s.patches[n, m, 2])
        off = s.patches[n, m, 0] - z
        reach = 0.5 * PATCH_M * slopes + SAME_M
        return off > -reach and (kind == WALL or off < reach)
    if kind == TREE:
        return s.tree_view[index] & view != 0
    if kind in (ROOF, WALL):
        return s.box_view[index] & view != 0
    return True


@inlined
def in_shadow(s, sun, x, y, z, view):
    """Whether a building or tree of a view stands between a surface point and the sun.

    ``sun``: the three values of ``s.sun``, which as a tuple are divided once for all points.
    """
    ny, nx = s.cell_top.shape
    i, j = int((x - s.x0) / CELL_M), int((y - s.y0) / CELL_M)
    if i < 0 or j < 0 or i >= nx or j >= ny:
        return False
    if z >= s.sun_top[j, i]:
        return False
    bx, by = sun[0] / sun[2], sun[1] / sun[2]
    ax, ay = x - bx * z, y - by * z
    clear = z + 0.02
    step_x, step_y = 1 if bx > 0 else -1, 1 if by > 0 else -1
    per_x, per_y = CELL_M / max(abs(bx), 1e-9), CELL_M / max(abs(by), 1e-9)
    next_x = (s.x0 + CELL_M * (i + (1 if bx > 0 else 0)) - ax) * (1 / bx)
    next_y = (s.y0 + CELL_M * (j + (1 if by > 0 else 0)) - ay) * (1 / by)
    while z < s.sun_top[j, i]:
        if s.cell_top[j, i] > z:
            cell = j * nx + i
            for n in range(s.box_first[cell], s.box_first[cell + 1]):
                k = s.box_list[n]
                if s.box_view[k] & view and s.boxes[k, 6] + s.boxes[k, 7] > clear:
                    low, high, _ = box_span(s.boxes, k, ax, ay, bx, by)
                    if high >= low and high > clear:
                        return True
            for n in range(s.tree_first[cell], s.tree_first[cell + 1]):
                k = s.tree_list[n]
                if (
                    s.tree_view[k] & view
                    and s.trees[k, 2] + s.trees[k, 4] > clear
                    and tree_top(s.trees, k, ax, ay, bx, by) > clear + 0.1
                ):
                    return True
            if s.patches.shape[0] > 0:
                leaves = min(next_x, next_y, s.cell_top[j, i])
                high, _, _ = patch_top(s, i, j, ax, ay, bx, by, max(z, clear), leaves)
                if high > clear:
                    return True
        if next_x < next_y:
            z = next_x
            next_x += per_x
            i += step_x
        else:
            z = next_y
            next_y += per_y
            j += step_y
        if i < 0 or j < 0 or i >= nx or j >= ny:
            break
    return False


def _widened(cell_top: np.ndarray, cells: int) -> np.ndarray:
    """Greatest value within so many cells to each side."""
    ny, nx = cell_top.shape
    rows = np.pad(cell_top, ((cells, cells), (0, 0)), mode="edge")
    top = np.max([rows[k : k + ny] for k in range(2 * cells + 1)], axis=0)
    columns = np.pad(top, ((0, 0), (cells, cells)), mode="edge")
    return np.max([columns[:, k : k + nx] for k in range(2 * cells + 1)], axis=0)


def horizon(cell_top: np.ndarray, lean_x: float, lean_y: float) -> np.ndarray:
    """z above which a ray that passes a cell upwards meets nothing more, float32[ny, nx].

    For rays x = ax + lean_x z, y = ay + lean_y z, or a little off (2 degrees in direction).
    """
    lean = math.hypot(lean_x, lean_y)
    padded = np.pad(_widened(cell_top, 1), REACH_CELLS, constant_values=-1e9)
    ny, nx = cell_top.shape
    top = np.full(cell_top.shape, -1e9, np.float32)
    for k in range(REACH_CELLS + 1):
        i = REACH_CELLS + round(k * lean_x / max(lean, 1e-9))
        j = REACH_CELLS + round(k * lean_y / max(lean, 1e-9))
        # a ray that is k cells away has risen by at least this much
        rise = max(k - 2.0, 0.0) * CELL_M / max(lean, 1e-9)
        np.maximum(top, padded[j : j + ny, i : i + nx] - rise, out=top)
    return top


def lidar_horizon(cell_top: np.ndarray) -> np.ndarray:
    """:func:`horizon` of rays that lean by up to LIDAR_LEAN to any side."""
    top = cell_top.copy()
    for k in range(1, 8):
        np.maximum(top, _widened(cell_top, k) - (k - 1) * CELL_M / LIDAR_LEAN, out=top)
    return top


@kernel
def _heights(s, xy, out):
    for n in range(xy.shape[0]):
        out[n, 0], out[n, 1], out[n, 2] = terrain_at(s, xy[n, 0], xy[n, 1])


def terrain_heights(s: Surfaces, xy: np.ndarray) -> np.ndarray:
    """Terrain z (m) and its derivatives along x and y, [n, 3], at plan positions [n, 2]."""
    xy = np.ascontiguousarray(xy, dtype=np.float64)
    out = np.empty((len(xy), 3))
    _heights(s, xy, out)
    return out
