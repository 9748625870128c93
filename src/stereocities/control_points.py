"""Ground control points and check points: sharp roof corners, and places on open ground."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from stereotruth.core.kernels import kernel
from stereotruth.core.products.files import write_table

from .camera import project_point
from .cities import CitySpec, SceneSpec
from .layout import scene_coordinates
from .render import Camera, ImagedScene, prepare
from .surfaces import (
    ANY_VIEW,
    IN_IMAGES,
    IN_LIDAR,
    NOTHING,
    PATCH_M,
    PATCHES_A_CELL,
    Surfaces,
    cast,
    terrain_heights,
)
from .truth import seen_from

log = logging.getLogger("stereotruth")


FIELDS = ("id", "lon", "lat", "height", "left_col", "left_row", "right_col", "right_row")
GCP_COUNT = 20
CHECKPOINT_COUNT = 80
GCP_NOISE_PX = 0.25
FRAME_MARGIN_PX = 30.0
CLEAR_M = 0.005  # below which nothing hides a point
MARKS_M = 4.0  # between the places of a twin that can be measured


@kernel
def _see(view, xyz, image, seen):
    """Image coordinates (col, row) of points in one image, and whether it shows them."""
    line = np.empty(12)
    m = FRAME_MARGIN_PX
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        col, row = project_point(view.cam, x, y, z, 0.5 * view.rows, line)
        free = seen_from(view.surfaces, view.above, x, y, z, line, view.shown, CLEAR_M)
        image[n, 0], image[n, 1] = col, row
        seen[n] = free and m < col < view.cols - m and m < row < view.rows - m


def visible_in(camera: Camera, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates [n, 2] (col, row) of world points [n, 3], and whether the image shows them.

    What lies within FRAME_MARGIN_PX of the frame does not count as shown.
    """
    image, seen = np.empty((len(xyz), 2)), np.zeros(len(xyz), bool)
    _see(camera.sight, np.ascontiguousarray(xyz), image, seen)
    return image, seen


def _visible(ready: ImagedScene, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates [n, 4] in left and right, and whether both show the points."""
    left, in_left = visible_in(ready.left, xyz)
    right, in_right = visible_in(ready.right, xyz)
    return np.column_stack([left, right]), in_left & in_right


def marks(s: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 3] that can be measured in images, and the building of each.

    Corners of flat roofs that stand free, unchanged; of a twin, middles of patches of roofs and of
    the ground, each of which counts as a building.
    """
    if s.patches.size:
        return _middles(s)
    b = s.boxes
    area = b[:, 4] * b[:, 5]
    use = np.flatnonzero((b[:, 7] == 0) & (s.box_view == (IN_IMAGES | IN_LIDAR)) & (area > 20))
    corners, owner = [], []
    for i in (-1, 1):
        for j in (-1, 1):
            u, v = i * b[use, 4], j * b[use, 5]
            corners.append(np.column_stack([
                b[use, 0] + u * b[use, 2] - v * b[use, 3],
                b[use, 1] + u * b[use, 3] + v * b[use, 2],
                b[use, 6],
            ]))  # fmt: skip
            owner.append(use)
    xyz, owner = np.concatenate(corners), np.concatenate(owner)
    free = np.ones(len(xyz), bool)
    # not inside or against another part of a building
    reach = np.hypot(b[:, 4], b[:, 5]) + 1.5
    near = cKDTree(xyz[:, :2]).query_ball_point(b[:, :2], reach)
    box = np.repeat(np.arange(len(b)), [len(n) for n in near])
    corner = np.concatenate([np.array(n, int) for n in near])
    dx, dy = xyz[corner, 0] - b[box, 0], xyz[corner, 1] - b[box, 1]
    u = np.abs(dx * b[box, 2] + dy * b[box, 3]) - b[box, 4]
    v = np.abs(dy * b[box, 2] - dx * b[box, 3]) - b[box, 5]
    free[corner[(u < 1.0) & (v < 1.0) & (owner[corner] != box)]] = False
    return xyz[free], owner[free]


def _middles(s: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Every so many metres the middle of a patch, or the ground below it, and a number of each."""
    step = round(MARKS_M / PATCH_M)
    some = s.patches[step // 2 :: step, step // 2 :: step, 0].astype(np.float64)
    j, i = (a.ravel() for a in np.indices(some.shape))
    x, y = (
        low + PATCH_M * (PATCHES_A_CELL * cell + step // 2 + step * k + 0.5)
        for low, cell, k in ((s.x0, s.patch_i, i), (s.y0, s.patch_j, j))
    )
    xy = np.column_stack([x, y])
    z = np.where(some > NOTHING, some, terrain_heights(s, xy)[:, 0].reshape(some.shape))
    return np.column_stack([xy, z.ravel()]), np.arange(some.size)


def spread_out(where: np.ndarray, count: int, start: np.ndarray) -> list[int]:
    """Indices of ``count`` points [n, 2], each as far as can be from those before (and start)."""
    chosen: list[int] = []
    distance = np.full(len(where), np.inf)
    for point in start:
        distance = np.minimum(distance, np.hypot(*(where - point).T))
    for _ in range(min(count, len(where))):
        n = int(np.argmax(distance))
        if distance[n] <= 0:
            break
        chosen.append(n)
        distance = np.minimum(distance, np.hypot(*(where - where[n]).T))
    return chosen


def _table(ready: ImagedScene, names: list[str], xyz: np.ndarray, image: np.ndarray) -> list[dict]:
    ground = ready.frame.to_geodetic(xyz)
    return [
        dict(zip(FIELDS, (
            name, f"{g[0]:.10f}", f"{g[1]:.10f}", f"{g[2]:.4f}", *(f"{v:.4f}" for v in i)
        )))
        for name, g, i in zip(names, ground, image)
    ]  # fmt: skip


def make_points(
    city: CitySpec, scene: SceneSpec, *, seed: int
) -> tuple[list[dict], list[dict], list[dict]]:
    """Measured GCPs, the same without measurement noise, and independent exact check points.

    GCPs are :func:`marks` that both views show, spread as evenly as the city has them. Check points
    are other buildings' corners and points on open ground. ``seed`` draws the noise of the GCPs'
    image coordinates (0.25 px each); their ground coordinates are exact.
    """
    ready = prepare(city, scene)
    s = ready.surfaces
    xyz, owner = marks(s)
    image, seen = _visible(ready, xyz)
    xyz, owner, image = xyz[seen], owner[seen], image[seen]
    middle = np.array([[(ready.left.cols - 1) / 2, (ready.left.rows - 1) / 2]])
    chosen = spread_out(image[:, :2], GCP_COUNT, middle)
    chosen.sort(key=lambda n: (image[n, 1] // 400, image[n, 0]))
    names = [f"G{n:02d}" for n in range(1, len(chosen) + 1)]
    exact = _table(ready, names, xyz[chosen], image[chosen])
    rng = np.random.default_rng([seed, scene.pose_seed])
    noisy = image[chosen] + rng.normal(0, GCP_NOISE_PX, (len(chosen), 4))
    measured = _table(ready, names, xyz[chosen], noisy)

    others = ~np.isin(owner, owner[chosen])
    own = np.random.default_rng([scene.pose_seed, 8])
    corners = np.flatnonzero(others)
    corners = corners[spread_out(image[corners, :2], CHECKPOINT_COUNT // 2, image[chosen, :2])]
    # open ground that is seen from above as well: no crown or roof over it
    xy = np.array(scene.centre_m) + own.uniform(-1, 1, (4000, 2)) * 0.65 * max(
        scene.cols, scene.rows
    )
    local = np.abs(scene_coordinates(city, scene, xy))
    xy = xy[(local < np.array([scene.cols, scene.rows]) * 0.325).all(axis=1)]
    z = terrain_heights(s, xy)[:, 0]
    ground = np.column_stack([xy, z])[z > s.water + 0.3]
    ground = ground[_open_sky(s, ground)]
    spots, seen = _visible(ready, ground)
    ground, spots = ground[seen], spots[seen]
    used = np.concatenate([image[chosen, :2], image[corners, :2]])
    flat = spread_out(spots[:, :2], CHECKPOINT_COUNT - len(corners), used)
    where = np.concatenate([xyz[corners], ground[flat]])
    names = [f"C{n:03d}" for n in range(1, len(where) + 1)]
    checks = _table(ready, names, where, np.concatenate([image[corners], spots[flat]]))
    log.info("%s: %d ground control points, %d check points", scene.name, len(chosen), len(where))
    return measured, exact, checks


@kernel
def _open(s, xyz, out):
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        a, kind_a, _, _, _, _, _ = cast(s, s.lidar_top, x, y, 0.0, 0.0, ANY_VIEW, True, z)
        b, kind_b, _, _, _, _, _ = cast(s, s.lidar_top, x, y, 0.0, 0.0, IN_LIDAR, True, z)
        out[n] = kind_a != 0 and kind_b != 0 and a < z + CLEAR_M and b < z + CLEAR_M


def _open_sky(s, xyz: np.ndarray) -> np.ndarray:
    out = np.zeros(len(xyz), bool)
    _open(s, np.ascontiguousarray(xyz), out)
    return out


def simulate_points(
    city: CitySpec,
    scene: SceneSpec,
    gcps_csv: str | Path,
    gcps_exact_csv: str | Path,
    checkpoints_csv: str | Path,
    *,
    seed: int,
) -> None:
    """Write measured GCPs, exact GCPs and check points of a scene."""
    measured, exact, checks = make_points(city, scene, seed=seed)
    write_table(gcps_csv, measured, FIELDS)
    write_table(gcps_exact_csv, exact, FIELDS)
    write_table(checkpoints_csv, checks, FIELDS)
