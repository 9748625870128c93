"""Training, validation and testing: counts as in the paper's table 3, no ground in two splits.

Two tiles share ground if they come from one scene and their windows overlap (exact: a left image
sees a place once), or from two scenes and the footprints of their left images overlap on the
ground by more than ``TOLERANCE_PX``. Splits are runs of tiles along a sweep across the epipolar
rows. A match lies in the same row, so that a tile above or below another one shares nothing with
it, not even in the right image; that the right image of a tile reaches a little into the tile
beside it matters at the few places only where a split ends within a row.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ..core.numerics.geometry import metres_per_degree
from .manifest import NONE, SPLITS, Tile, manifest_rows

# Footprints follow the heights on the tile's border; what leans across it by less than this many
# pixels (a roof 30 m high in a view 5° off nadir at 0.65 m) does not count as shared.
TOLERANCE_PX = 4.0


@dataclass(frozen=True, eq=False)
class Place:
    """Where a tile lies: scene, window in that scene's epipolar grid (px), ring on the ground.

    ``ring`` is float64[4 k, 2] lon, lat in degrees of the border of the left image: upper left,
    upper right (entry k), lower right (2 k), lower left (3 k), not closed.
    """

    scene: str
    row0: int
    col0: int
    size: int
    ring: NDArray[np.float64]


def scaled_counts(total: int, weights: Mapping[str, int]) -> dict[str, int]:
    """Share out ``total`` tiles by the weights: largest remainder, the sum is exact.

    Every split with a weight gets a tile if there are enough. No weight at all means testing.
    """
    weights = {name: weights.get(name, 0) for name in SPLITS}
    if not any(weights.values()):
        weights["test"] = 1
    whole = sum(weights.values())
    counts = {name: total * weight // whole for name, weight in weights.items()}
    by_remainder = sorted(SPLITS, key=lambda name: -(total * weights[name] % whole))
    for name in by_remainder[: total - sum(counts.values())]:
        counts[name] += 1
    wanting = [name for name in SPLITS if weights[name] and not counts[name]]
    for name in wanting:
        largest = max(SPLITS, key=counts.__getitem__)
        if counts[largest] > 1:
            counts[largest] -= 1
            counts[name] += 1
    return counts


def _metric(places: Sequence[Place]) -> list[NDArray[np.float64]]:
    """Rings in metres east and north of the first tile (equirectangular; one city is small)."""
    origin = places[0].ring[0]
    scale = metres_per_degree(origin[1])
    rings = []
    for place in places:
        ring = place.ring - origin
        ring[:, 0] = (ring[:, 0] + 180.0) % 360.0 - 180.0
        rings.append(ring * scale)
    return rings


def _depth(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Depth of overlap of two convex rings (separating axes), negative if they are apart."""
    least = np.inf
    for ring in (a, b):
        edge = np.roll(ring, -1, axis=0) - ring
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        pa, pb = normal @ a.T, normal @ b.T
        overlap = np.minimum(pa.max(axis=1), pb.max(axis=1)) - np.maximum(
            pa.min(axis=1), pb.min(axis=1)
        )
        least = min(least, float(overlap.min()))
    return least


def overlaps(places: Sequence[Place]) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of tiles that share ground."""
    if len(places) < 2:
        return []
    row = np.array([place.row0 for place in places])
    col = np.array([place.col0 for place in places])
    size = np.array([place.size for place in places])
    scene = np.array([place.scene for place in places])
    hulls = [ring[ConvexHull(ring).vertices] for ring in _metric(places)]
    centre = np.array([hull.mean(axis=0) for hull in hulls])
    radius = np.array([np.linalg.norm(h - c, axis=1).max() for h, c in zip(hulls, centre)])
    pixel = radius * np.sqrt(2.0) / size
    pairs = []
    for i in range(len(places) - 1):
        rest = slice(i + 1, None)
        same = scene[rest] == scene[i]
        side = np.minimum(size[rest], size[i])
        window = (abs(row[rest] - row[i]) < side) & (abs(col[rest] - col[i]) < side)
        near = np.linalg.norm(centre[rest] - centre[i], axis=1) < radius[rest] + radius[i]
        for k in np.flatnonzero(np.where(same, window, near)):
            j = i + 1 + int(k)
            if same[k] or _depth(hulls[i], hulls[j]) > TOLERANCE_PX * pixel[i]:
                pairs.append((i, j))
    return pairs


def _sweep(places: Sequence[Place]) -> NDArray[np.intp]:
    """Tiles row by row of the first scene's grid, as it lies on the ground, to and fro.

    Every other row goes backwards, so that a run that ends within a row stays in one piece.
    """
    rings = _metric(places)
    first = [ring for ring, place in zip(rings, places) if place.scene == places[0].scene]
    along = np.mean([ring[len(ring) // 4] - ring[0] for ring in first], axis=0)
    down = np.mean([ring[3 * len(ring) // 4] - ring[0] for ring in first], axis=0)
    side = np.linalg.norm(along)
    along = along / side
    across = np.array([-along[1], along[0]])
    across *= np.sign(across @ down)
    centre = np.array([ring.mean(axis=0) for ring in rings])
    centre -= centre[0]
    # Rows of a grid lie on the ground with small bends: an eighth of a tile bears them.
    line = np.rint(8.0 * (centre @ across) / side)
    rank = np.unique(line, return_inverse=True)[1]
    forth = np.where(rank % 2, -1.0, 1.0)
    return np.lexsort((forth * (centre @ along), line))


def _cover(pairs: Sequence[tuple[int, int]], run: Sequence[int] | None = None) -> set[int]:
    """Few tiles that between them take part in all pairs: always the one with most pairs next.

    With the ``run`` of each tile, pairs count by the length of the run, so that the tiles go
    from long runs and a short one (validation) survives between two.
    """
    left = list(pairs)
    length = {} if run is None else dict(zip(*np.unique(run, return_counts=True)))
    taken: set[int] = set()
    while left:
        count: dict[int, int] = {}
        for pair in left:
            for tile in pair:
                count[tile] = count.get(tile, 0) + (1 if run is None else int(length[run[tile]]))
        worst = max(sorted(count), key=count.__getitem__)
        taken.add(worst)
        if run is not None:
            length[run[worst]] -= 1
        left = [pair for pair in left if worst not in pair]
    return taken


def split_tiles(places: Sequence[Place], weights: Mapping[str, int], seed: int) -> list[str]:
    """A split for each tile: ``train``, ``val``, ``test``, or ``none``.

    ``weights`` are the paper's counts by split name. Tiles are taken in sweep order, in runs
    whose lengths are :func:`scaled_counts`; the seed draws which split comes first. A run ends
    a little earlier or later where that costs fewer tiles; tiles that share ground with a tile
    across the end of a run get ``none`` (as few as a greedy search finds, of long runs first).
    If that leaves a split without a tile, it is done again without the least of the splits.
    """
    if not places:
        return []
    counts = scaled_counts(len(places), weights)
    rng = np.random.default_rng(seed)
    names = [name for name in rng.permutation(SPLITS).tolist() if counts[name]]
    order = _sweep(places)
    if rng.integers(2):
        order = order[::-1]
    position = np.empty_like(order)
    position[order] = np.arange(order.size)
    pairs = [
        (min(p, q), max(p, q))
        for p, q in ((int(position[i]), int(position[j])) for i, j in overlaps(places))
    ]
    cuts, target = [0], 0
    for k, name in enumerate(names[:-1], start=1):
        target += counts[name]
        low, high = cuts[-1] + 1, len(places) - (len(names) - k)
        best, cost = target, np.inf
        # A split is moved by a sixth of its tiles at most, or by one: counts are the point.
        reach = max(1, min(counts[name], counts[names[k]]) // 6)
        for step in range(reach + 1):
            for cut in (target - step, target + step):
                if low <= cut <= high and step < cost:
                    lost = len(_cover([(p, q) for p, q in pairs if p < cut <= q]))
                    if step + 2 * lost < cost:  # a tile lost is worse than one moved
                        best, cost = cut, step + 2 * lost
        cuts.append(best)
    run = np.searchsorted(cuts[1:], np.arange(len(places)), side="right")
    none = _cover([(p, q) for p, q in pairs if run[p] != run[q]], run.tolist())
    found = [NONE if p in none else names[run[p]] for p in position.tolist()]
    if all(name in found for name in names):
        return found
    fewest = min(names, key=lambda name: weights.get(name, 0))
    return split_tiles(places, {n: w for n, w in weights.items() if n != fewest}, seed)


def shared_ground(*manifests: str | Path) -> list[tuple[str, str]]:
    """Names of tiles of different splits that share ground, from manifests and their sidecars.

    ``manifests`` are the ``manifest.csv`` of one or several ``tiles/<City>``. Tiles without a
    split do not count.
    """
    names, split, places = [], [], []
    for manifest in map(Path, manifests):
        for tile in map(Tile.of, manifest_rows(manifest)):
            if tile.split in SPLITS:
                file = manifest.parent / tile.row["orientation"]
                sidecar = json.loads(file.read_text("utf-8"))
                ring = np.array(sidecar["footprint"]["coordinates"][0][:-1])
                places.append(Place(tile.scene, tile.row0, tile.col0, tile.size, ring))
                names.append(tile.name)
                split.append(tile.split)
    return [(names[i], names[j]) for i, j in overlaps(places) if split[i] != split[j]]
