"""How bright a surface point looks: materials fixed to the surfaces, one sun, hard shadows.

Brightness depends on the surface point, not on from where it is seen, so that both views of a pair
show the same patterns. Shadows are those of the view's own sun and objects.
"""

from __future__ import annotations

import math

import numpy as np

from stereotruth.core.kernels import inlined

from .surfaces import (
    CELL_M,
    FIRST_PATCH,
    GROUND,
    PATCH_M,
    PATCHES_A_CELL,
    ROOF,
    TREE,
    WATER,
    in_shadow,
)

SKY = 0.34  # diffuse share of the light
GROUND_MEAN = 0.2  # reflectance that the ground keeps whatever its contrast
VEHICLE = 4  # kind of roof cover, beside those of buildings
PAINT = 65535.0
SIDE_ALBEDO = 0.34  # of the sides of patches
CLEAR_M = 0.4  # from a side, whose steps would shade each other


@inlined
def _hash(i, j, k):
    """Uniform number in [0, 1) of three integers."""
    h = (i * 374761393 + j * 668265263 + k * 2147483647) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return (h ^ (h >> 15)) / 4294967296.0


@inlined
def _sample(texture, u, v):
    """Bilinear value of a periodic texture at (u, v) in its pixels; the size is a power of two."""
    mask = texture.shape[0] - 1
    fu, fv = np.floor(u), np.floor(v)
    f, g = u - fu, v - fv
    iu, iv = int(fu), int(fv)
    i, j = np.uint64(iu & mask), np.uint64(iv & mask)
    k, m = np.uint64((iu + 1) & mask), np.uint64((iv + 1) & mask)
    top = texture[j, i] * (1 - f) + texture[j, k] * f
    return top * (1 - g) + (texture[m, i] * (1 - f) + texture[m, k] * f) * g


@inlined
def zone_at(s, x, y):
    """Land use zone of a plan position."""
    i, j = int((x - s.x0) / CELL_M), int((y - s.y0) / CELL_M)
    ny, nx = s.zone_cells.shape
    zone = s.zone_cells[min(max(j, 0), ny - 1), min(max(i, 0), nx - 1)]
    if zone >= 0:
        return zone
    row, best = -1 - zone, 1e30
    for k in range(s.zone_near.shape[1]):
        n = s.zone_near[row, k]
        if n < 0:
            break
        dx, dy = x - s.zones[n, 0], y - s.zones[n, 1]
        d = dx * dx + dy * dy
        if d < best:
            best, zone = d, n
    return zone


@inlined
def _is_resurfaced(s, i, j, along_q):
    """Whether a stretch of a street along block (i, j) has the texture of a new surface."""
    return s.resurfaced > 0.0 and _hash(int(i), int(j), 23 + int(along_q)) < s.resurfaced


@inlined
def _in_block(s, n, x, y):
    """A plan position along the axes of a zone, numbers of its block, distances to its edges."""
    p = x * s.zones[n, 2] + y * s.zones[n, 3]
    q = y * s.zones[n, 2] - x * s.zones[n, 3]
    i, j = np.floor(p / s.zones[n, 4]), np.floor(q / s.zones[n, 5])
    pe, qe = p - i * s.zones[n, 4], q - j * s.zones[n, 5]
    return p, q, i, j, min(pe, s.zones[n, 4] - pe), min(qe, s.zones[n, 5] - qe)


@inlined
def resurfaced_at(s, x, y):
    """Whether the ground at a plan position is a street with the texture of a new surface."""
    n = zone_at(s, x, y)
    if s.zones[n, 7] >= 5:
        return False
    _, _, i, j, pe, qe = _in_block(s, n, x, y)
    return min(pe, qe) < s.zones[n, 6] and _is_resurfaced(s, i, j, pe < qe)


@inlined
def _ground(s, x, y, slope2):
    """Reflectance of the ground; ``slope2``: its slope squared."""
    fine = _sample(s.fine, 4.0 * x, 4.0 * y)
    # the same texture turned and enlarged: no pattern repeats within a scene
    mid = _sample(s.fine, 1.13 * x + 0.83 * y, 1.13 * y - 0.83 * x)
    broad = _sample(s.broad, 0.5 * x, 0.5 * y)
    n = zone_at(s, x, y)
    kind = int(s.zones[n, 7])
    if slope2 > 0.24 * 0.24 and kind != 8:
        kind = 7
    p, q, i, j, pe, qe = _in_block(s, n, x, y)
    edge = min(pe, qe)
    chance = _hash(int(i), int(j), int(s.zones[n, 8] * 1e6))
    if kind < 5:
        if edge < s.zones[n, 6]:  # street
            along = q if pe < qe else p
            value = 0.155 + 0.02 * s.zones[n, 8] + 0.016 * fine + 0.022 * mid + 0.012 * broad
            if s.zones[n, 6] > 3.5 and edge < 0.22 and along - 8 * math.floor(along / 8) < 4:
                value = 0.42
            if _is_resurfaced(s, i, j, pe < qe):
                value = 0.1 + 0.016 * _sample(s.fine, 4.0 * x + 311.0, 4.0 * y + 173.0)
                value += 0.022 * _sample(s.fine, 1.13 * x + 517.0, 1.13 * y - 91.0)
            # vehicles: parked and moving ones stand still for the seconds between the views
            slot = math.floor(along / 9.0)
            lane = s.zones[n, 6] - 2.6
            offset = along - 9.0 * slot
            side = int(pe < qe) + 2 * int(
                (p - i * s.zones[n, 4] < s.zones[n, 4] / 2)
                if pe < qe
                else (q - j * s.zones[n, 5] < s.zones[n, 5] / 2)
            )
            car = _hash(int(slot), int(i * 7919 + j), 17 + side)
            if (
                s.zones[n, 6] > 3.5
                and car < 0.3
                and abs(edge - lane) < 0.95
                and offset > 2
                and offset < 6.4
            ):
                value = 0.08 + 2.2 * car if car > 0.06 else 0.75
            return value
        if edge < s.zones[n, 6] + 2.2 and s.zones[n, 6] > 3.5:
            return 0.30 + 0.03 * fine + 0.03 * mid
        green = 0.55 * mid + 0.8 * broad + 2.2 * (chance - 0.5)
        if kind == 4:
            return 0.27 + 0.08 * (chance - 0.5) + 0.025 * fine + 0.035 * mid + 0.03 * broad
        if green > 0.15:
            return 0.125 + 0.032 * fine + 0.02 * mid
        if green > 0.02:
            return 0.22 + 0.03 * fine
        return 0.25 + 0.12 * (chance - 0.5) + 0.028 * fine + 0.035 * mid
    if kind == 5:  # park: lawn and winding paths
        if abs(0.7 * broad + 0.1 * mid) < 0.035:
            return 0.36 + 0.03 * fine
        return 0.14 + 0.03 * fine + 0.025 * mid + 0.02 * broad
    if kind == 6:  # fields
        if edge < s.zones[n, 6]:
            return 0.30 + 0.04 * fine
        crop = _hash(int(i), int(j), 5)
        furrow = 1.1 + 1.6 * crop
        lines = math.sin(2 * math.pi * (q if chance > 0.3 else p) / furrow + 1.5 * mid)
        return (
            0.11
            + 0.19 * chance
            + 0.018 * lines
            + (0.02 + 0.015 * crop) * fine
            + 0.025 * mid
            + 0.012 * broad
        )
    if kind == 7:  # under trees: litter, grass
        return 0.12 + 0.035 * fine + 0.025 * mid + 0.015 * broad
    return 0.21 + 0.05 * fine + 0.045 * mid + 0.03 * broad


@inlined
def _painted(s, x, y):
    """Reflectance by the paint at a plan position, with detail of less than a metre; negative where
    there is no paint."""
    u = (x - s.x0) / PATCH_M - PATCHES_A_CELL * s.patch_i - 0.5
    v = (y - s.y0) / PATCH_M - PATCHES_A_CELL * s.patch_j - 0.5
    i, j = int(np.floor(u)), int(np.floor(v))
    if i < 0 or j < 0 or i >= s.paint.shape[1] - 1 or j >= s.paint.shape[0] - 1:
        return -1.0
    f, g = u - i, v - j
    value = weight = 0.0
    for n in range(2):
        for m in range(2):
            paint = s.paint[j + n, i + m]
            if paint > 0:
                w = (f if m else 1 - f) * (g if n else 1 - g)
                value += w * paint
                weight += w
    if weight < 1e-3:
        return -1.0
    fine = _sample(s.fine, 4.0 * x, 4.0 * y)
    mid = _sample(s.fine, 1.13 * x + 0.83 * y, 1.13 * y - 0.83 * x)
    return value / (weight * PAINT) * (1 + 0.09 * fine + 0.08 * mid)


@inlined
def _facade(s, albedo, along, z, phase, number):
    """Reflectance of a wall with windows; ``number`` and ``phase`` tell walls apart."""
    fine = _sample(s.fine, 4.0 * along + phase[0], 4.0 * z + phase[1])
    value = albedo * (1 + 0.10 * fine)
    storey = z - 3.0 * math.floor(z / 3.0)
    bay = along - 3.4 * math.floor(along / 3.4)
    if storey > 0.9 and storey < 2.4 and bay > 0.7 and bay < 2.6:
        glass = _hash(int(np.floor(along / 3.4)), int(np.floor(z / 3.0)), number)
        value = 0.07 + 0.16 * glass * glass
    return value


@inlined
def reflectance(s, sun, view, x, y, z, kind, index, face, slope):
    """Light that comes back from a surface point, about 0 to 1.

    ``sun``: the three values of ``s.sun``. ``view``: bits of the objects that are there. ``slope``:
    that of the ground along x and y.
    """
    nx, ny, nz = 0.0, 0.0, 1.0
    shaded_x, shaded_y = x, y
    if kind == GROUND:
        zx, zy = slope
        value = _painted(s, x, y) if s.paint.shape[0] > 0 else -1.0
        if value < 0:
            value = _ground(s, x, y, zx * zx + zy * zy)
        if s.ground_look[1] != 1.0:
            value = GROUND_MEAN + s.ground_look[1] * (value - GROUND_MEAN)
        value *= s.ground_look[0]
        n = 1 / math.sqrt(1 + zx * zx + zy * zy)
        nx, ny, nz = -zx * n, -zy * n, n
    elif kind == WATER:
        value = 0.06 + 0.004 * _sample(s.fine, 1.7 * x, 1.7 * y) + 0.006 * _sample(s.broad, x, y)
    elif kind == TREE:
        nx = (x - s.trees[index, 0]) / (s.trees[index, 3] * s.trees[index, 3])
        ny = (y - s.trees[index, 1]) / (s.trees[index, 3] * s.trees[index, 3])
        nz = (z - s.trees[index, 2]) / (s.trees[index, 4] * s.trees[index, 4])
        n = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * n, ny * n, nz * n
        leaf = _sample(s.fine, 4.1 * x + 2.3 * z, 4.1 * y - 1.7 * z)
        value = (
            0.15 + 0.05 * (s.trees[index, 3] - math.floor(s.trees[index, 3]) - 0.5) + 0.062 * leaf
        )
        value *= s.tree_style[index, 0]
    elif index <= FIRST_PATCH:
        number = FIRST_PATCH - index
        n, m = number // s.patches.shape[1], number % s.patches.shape[1]
        if kind == ROOF:
            zx, zy = s.patches[n, m, 1], s.patches[n, m, 2]
            value = max(_painted(s, x, y), 0.0)
            scale = 1 / math.sqrt(1 + zx * zx + zy * zy)
            nx, ny, nz = -zx * scale, -zy * scale, scale
        else:
            looks = s.patch_side[n, m] * (math.pi / 128)
            nx, ny, nz = math.cos(looks), math.sin(looks), 0.0
            value = _facade(s, SIDE_ALBEDO, y * nx - x * ny, z, (0.0, 0.0), s.patch_side[n, m])
            shaded_x, shaded_y = x + CLEAR_M * nx, y + CLEAR_M * ny
    else:
        u = (x - s.boxes[index, 0]) * s.boxes[index, 2] + (y - s.boxes[index, 1]) * s.boxes[
            index, 3
        ]
        v = (y - s.boxes[index, 1]) * s.boxes[index, 2] - (x - s.boxes[index, 0]) * s.boxes[
            index, 3
        ]
        if kind == ROOF:
            fine = _sample(
                s.fine, 4.0 * u + s.box_style[index, 3], 4.0 * v + 1.7 * s.box_style[index, 3]
            )
            mid = _sample(s.fine, 1.3 * v - s.box_style[index, 3], 1.3 * u + s.box_style[index, 3])
            cover = int(s.box_style[index, 2])
            value = s.box_style[index, 0] * (1 + 0.10 * fine + 0.12 * mid)
            if s.boxes[index, 7] > 0:
                k = s.boxes[index, 7] / s.boxes[index, 5]
                n = 1 / math.sqrt(1 + k * k)
                side = 1.0 if face == 0 else -1.0
                nx, ny, nz = -side * k * n * s.boxes[index, 3], side * k * n * s.boxes[index, 2], n
            if cover == 2:  # tiles: lines down the slope
                value *= 1 + 0.07 * math.sin(2 * math.pi * u / 1.4)
            elif cover == 3:  # sheet metal: broad panels
                panel = math.floor(u / 6.0)
                value *= 0.92 + 0.16 * _hash(int(panel), index, 3)
            elif cover == 1:
                value *= 1 + 0.09 * fine
            rim = min(s.boxes[index, 4] - abs(u), s.boxes[index, 5] - abs(v))
            if s.boxes[index, 7] == 0 and cover != VEHICLE:
                if rim < 0.55:  # parapet
                    value = value * 0.6 + 0.18
                elif cover == 0 and s.boxes[index, 4] > 5:  # sheets of bitumen, plants, tanks
                    cell = _hash(int(np.floor(u / 3.1)), int(np.floor(v / 2.7)), index)
                    if cell < 0.10:
                        value *= 0.55 + 6 * cell
        else:
            if face < 4:
                along, side = v, 1.0 if face == 2 else -1.0
                nx, ny, nz = side * s.boxes[index, 2], side * s.boxes[index, 3], 0.0
            else:
                along, side = u, 1.0 if face == 4 else -1.0
                nx, ny, nz = -side * s.boxes[index, 3], side * s.boxes[index, 2], 0.0
            phase = s.box_style[index, 3], face * 97.0
            value = _facade(s, s.box_style[index, 1], along, z, phase, index + face)
    light = nx * sun[0] + ny * sun[1] + nz * sun[2]
    if light > 0 and in_shadow(s, sun, shaded_x, shaded_y, z, view):
        light = 0.0
    sky = SKY * (0.55 + 0.45 * nz)
    return max(value, 0.02) * (sky + max(light, 0.0) * ((1 - SKY) / sun[2]))
