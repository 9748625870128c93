"""What changed between three worlds, exactly: those of both images and of the LiDAR.

A ray goes through a pixel of one image and meets the surface of each world. What is highest on the
ray and is not in all worlds is the reason of the change.
"""

from __future__ import annotations

import numpy as np

from stereotruth.core.kernels import inlined, kernel

from .appearance import VEHICLE, resurfaced_at
from .camera import direction, pose
from .cities import CitySpec, SceneSpec
from .dated_worlds import world_of
from .render import in_collar, prepare
from .surfaces import GROUND, IN_LIDAR, NONE, ROOF, TREE, WALL, WATER, cast

UNCHANGED, BUILT, DEMOLISHED, GROWN_OR_FELLED, MOVED, WATER_LEVEL, GROUND_LEVEL, TEXTURE = range(8)
SAME_M = 0.01
LAYERS = {
    "height": "m above the frame's height: what the pixel's ray meets in the image's world",
    "height_other": "m: what it meets in the world of the other image",
    "height_lidar": "m: what it meets in the world of the LiDAR",
    "reason": "what changed there: one of REASONS",
}
REASONS = "none built demolished grown_or_felled moved water ground texture"


@inlined
def _reason(s, kind, index, z, scanned):
    """Of a surface at height ``z`` that is not in all worlds; ``scanned``: the LiDAR's height."""
    if kind == TREE:
        return GROWN_OR_FELLED
    if kind in (ROOF, WALL):
        if index >= 0 and s.box_style[index, 2] == VEHICLE:
            return MOVED
        return DEMOLISHED if scanned > z - SAME_M else BUILT
    return WATER_LEVEL if kind == WATER else GROUND_LEVEL


@kernel
def _changes(worlds, above, shown, cam, collar, size, image_col, image_row, heights, reason):
    """``worlds``: of the image, the other image and the LiDAR; ``shown`` [3]: their bits."""
    line = np.empty(12)
    z, kind, index = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(image_col.size):
        col, row = image_col[n], image_row[n]
        heights[:, n] = np.nan
        reason[n] = UNCHANGED
        inside = col >= -0.5 and row >= -0.5 and col <= size[0] - 0.5 and row <= size[1] - 0.5
        if not inside or in_collar(collar, col, row, size[0], size[1]):
            continue
        pose(cam, row, line)
        dx, dy, dz = direction(cam, line, col)
        bx, by = dx / dz, dy / dz
        ax, ay = line[0] - bx * line[2], line[1] - by * line[2]
        s0, s1, s2 = worlds
        z[0], kind[0], index[0], _, _, _, _ = cast(s0, above, ax, ay, bx, by, shown[0], True, 0.0)
        z[1], kind[1], index[1], _, _, _, _ = cast(s1, above, ax, ay, bx, by, shown[1], True, 0.0)
        z[2], kind[2], index[2], _, _, _, _ = cast(s2, above, ax, ay, bx, by, shown[2], True, 0.0)
        if kind.min() == NONE:
            continue
        heights[:, n] = z
        top = 0
        for k in range(1, 3):
            if z[k] > z[top]:
                top = k
        if z.max() - z.min() > SAME_M:
            of = kind[top]
            if of == GROUND and (kind == WATER).any():
                of = WATER  # the water has fallen below a ground that it does not show
            reason[n] = _reason(s0, of, index[top], z[top], z[2])
        elif kind[0] == GROUND:
            x, y = ax + bx * z[0], ay + by * z[0]
            if resurfaced_at(s0, x, y) != resurfaced_at(s1, x, y):
                reason[n] = TEXTURE


def changes_at(
    city: CitySpec, scene: SceneSpec, col: np.ndarray, row: np.ndarray, view: str = "left"
) -> dict[str, np.ndarray]:
    """The layers of LAYERS at positions (col, row) of an image of a scene, px, of any one shape.

    ``view``: left or right. Outside the image and in its collar heights are NaN, reasons none.
    """
    ready = prepare(city, scene)
    here, other = (ready.left, ready.right) if view == "left" else (ready.right, ready.left)
    worlds = here.surfaces, other.surfaces, world_of(city, ready.surfaces, "lidar")
    at = [np.ascontiguousarray(a, dtype=np.float64).ravel() for a in (col, row)]
    heights, reason = np.empty((3, at[0].size)), np.empty(at[0].size, np.uint8)
    _changes(
        worlds, here.horizon, np.array([here.shown, other.shown, IN_LIDAR]), here.cam, here.collar,
        np.array([here.cols, here.rows], np.float64), *at, heights, reason,
    )  # fmt: skip
    return dict(zip(LAYERS, (v.reshape(np.shape(col)) for v in (*heights, reason))))
