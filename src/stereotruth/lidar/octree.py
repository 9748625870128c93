"""Points of an octree (COPC, EPT) that lie in a footprint, with a proof that none is missing.

An octree keeps its points in nodes: cubes of half the side of their parent's. Which nodes may hold
points of a footprint follows from the octree's own cube, never from the header's bounds, which
writers get wrong. Before any point is read, the counts of all nodes of the hierarchy must add up to
the header's count. While points are read, each node must hold as many as the hierarchy says, all of
them within the node's cube: else other nodes may hold points of the footprint too, and the file is
refused. Sources: COPC 1.0 (Hobu), "Hierarchy"; EPT 1.1.0 (Hobu/Entwine), "Hierarchy".
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, in_number
from ..kernels import kernel

Floats = NDArray[np.float64]

MOST_LEVELS = 30  # keys of nodes stay within 32 bits
MOST_NODES = 4_000_000  # of a hierarchy, which is kept in memory
MOST_NODE_POINTS = 5_000_000  # decoded at once
STEPS_OUTSIDE = 2  # of the stored coordinates, that a point may lie outside of its node's cube
_WHOLE = "have the file written again, or download it and name the copy to read it whole"


@dataclass(frozen=True)
class Footprint:
    """Ground that the images see, in the coordinate system and units of the points.

    ``rings``: float64[n, 2] each, the corners of a polygon without holes, in either direction; a
    point lies in the footprint if it lies in any of them and from ``lowest`` to ``highest``.
    """

    rings: tuple[Floats, ...]
    lowest: float = -np.inf
    highest: float = np.inf

    def touches(self, low: Floats, high: Floats) -> bool:
        """Whether a box of corners ``low`` and ``high`` [3] has a place in common with it."""
        if high[2] < self.lowest or low[2] > self.highest:
            return False
        return any(_touches(ring, low[0], low[1], high[0], high[1]) for ring in self.rings)

    def contains(self, xyz: Floats) -> NDArray[np.bool_]:
        """Which of the points [3, n] lie in it."""
        inside = np.zeros(xyz.shape[1], np.bool_)
        for ring in self.rings:
            _mark(np.ascontiguousarray(ring, np.float64), xyz[0], xyz[1], inside)
        return inside & (xyz[2] >= self.lowest) & (xyz[2] <= self.highest)


@kernel
def _mark(ring: Floats, x: Floats, y: Floats, inside: NDArray[np.bool_]) -> None:
    """Set ``inside`` where an odd number of the ring's sides lies to the right of a point."""
    n = ring.shape[0]
    west, south, east, north = ring[0, 0], ring[0, 1], ring[0, 0], ring[0, 1]
    for i in range(n):
        west, east = min(west, ring[i, 0]), max(east, ring[i, 0])
        south, north = min(south, ring[i, 1]), max(north, ring[i, 1])
    for k in range(x.size):
        if x[k] < west or x[k] > east or y[k] < south or y[k] > north:
            continue
        odd = False
        j = n - 1
        for i in range(n):
            ax, ay, bx, by = ring[i, 0], ring[i, 1], ring[j, 0], ring[j, 1]
            if (ay > y[k]) != (by > y[k]) and x[k] < (bx - ax) * (y[k] - ay) / (by - ay) + ax:
                odd = not odd
            j = i
        inside[k] |= odd


def _touches(ring: Floats, west: float, south: float, east: float, north: float) -> bool:
    """Whether a polygon and a box have a point in common; their borders belong to them."""
    x, y = ring.T
    if x.max() < west or x.min() > east or y.max() < south or y.min() > north:
        return False
    if ((x >= west) & (x <= east) & (y >= south) & (y <= north)).any():
        return True
    inside = np.zeros(1, np.bool_)
    corner = np.array([west]), np.array([south])
    _mark(np.ascontiguousarray(ring, np.float64), *corner, inside)
    return bool(inside[0]) or _sides_cross(x, y, west, south, east, north)


def _sides_cross(
    x: Floats, y: Floats, west: float, south: float, east: float, north: float
) -> bool:
    """Whether a side of a polygon crosses a box: the part of it within the box is not empty."""
    ax, ay = np.roll(x, 1), np.roll(y, 1)
    first, last = np.zeros(x.size), np.ones(x.size)
    for start, step, low, high in ((ax, x - ax, west, east), (ay, y - ay, south, north)):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sort([(low - start) / step, (high - start) / step], axis=0)
        along = step == 0
        within = (start >= low) & (start <= high)
        first = np.maximum(first, np.where(along, np.where(within, 0, np.inf), t[0]))
        last = np.minimum(last, np.where(along, np.where(within, 1, -np.inf), t[1]))
    return bool((first <= last).any())


@dataclass(frozen=True)
class Node:
    """A node with points. ``start``: its first byte in the file, 0 where it has a file of its own.

    ``bytes`` of its compressed points; 0 where only its own file tells.
    """

    key: tuple[int, int, int, int]  # level, x, y, z
    points: int
    start: int
    bytes: int


@dataclass(frozen=True)
class NodePlan:
    """What is read for a footprint: the nodes in their order, their points and bytes.

    ``touched``: how many of the nodes may hold points of the footprint; the others (the root, one
    of the finest) are read to prove the octree's cube. None are read where none is touched.
    """

    footprint: Footprint | None
    nodes: tuple[Node, ...]
    touched: int

    @property
    def points(self) -> int:
        """Points of all nodes, in the footprint or not."""
        return sum(node.points for node in self.nodes)

    @property
    def bytes(self) -> int:
        """Bytes of all nodes; 0 where nodes have files of their own."""
        return sum(node.bytes for node in self.nodes)


class Octree(ABC):
    """An octree of points; made by :func:`open_octree`.

    ``name``: path or URL without secrets; ``header``: coordinate system, scales and offsets, point
    format, count and stated bounds of the whole; ``nodes``: all that have points, in their order;
    ``low``, ``side``: lowest corner [3] and side of the octree's cube.
    """

    name: str
    header: laspy.LasHeader
    nodes: tuple[Node, ...]
    low: Floats
    side: float

    @property
    def points(self) -> int:
        """Points of the whole, by its header."""
        return int(self.header.point_count)

    def box(self, node: Node) -> tuple[Floats, Floats]:
        """Lowest and highest corner [3] of a node's cube, with what rounding may add to it."""
        side = self.side / 2 ** node.key[0]
        low = self.low + np.array(node.key[1:], np.float64) * side
        slack = STEPS_OUTSIDE * np.asarray(self.header.scales)
        return low - slack, low + side + slack

    def plan(self, footprint: Footprint | None) -> NodePlan:
        """The nodes to read for a footprint in the octree's own system; all of them for None.

        Raises InputError if the header's bounds and the octree's cube contradict each other about
        whether there are points in the footprint.
        """
        if footprint is None:
            return NodePlan(None, self.nodes, len(self.nodes))
        touched = [node for node in self.nodes if footprint.touches(*self.box(node))]
        if not touched:
            mins, maxs = np.asarray(self.header.mins), np.asarray(self.header.maxs)
            if np.isfinite([mins, maxs]).all() and footprint.touches(mins, maxs):
                high = self.low + self.side
                beyond = (mins < self.low) | (maxs > high)
                if beyond.any():
                    raise self._refusal(
                        "the header's bounds reach out of the octree's cube, into the footprint"
                    )
            return NodePlan(footprint, (), 0)
        deepest = max(node.key[0] for node in self.nodes)
        chosen = {node.key for node in touched}
        if max(node.key[0] for node in touched) < deepest:
            chosen.add(next(node.key for node in self.nodes if node.key[0] == deepest))
        chosen.add(min(self.nodes, key=lambda node: node.key).key)
        nodes = tuple(node for node in self.nodes if node.key in chosen)
        return NodePlan(footprint, nodes, len(touched))

    def read(
        self, plan: NodePlan, progress: Callable[[int], None] | None = None
    ) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Points in the plan's footprint, node by node in the order of the file.

        Of each point X, Y, Z, returns, class, flags and GPS time are decoded. ``progress`` is
        called with the points that each node held. The order is the same whatever the footprint.

        Raises InputError: a node of other points than the hierarchy says, or points out of its
        cube; what a server or a damaged file fails with.
        """
        for node, points in zip(plan.nodes, self._decoded(plan.nodes), strict=True):
            xyz = self._checked(node, points)
            if progress is not None:
                progress(node.points)
            if plan.footprint is None:
                yield points
            elif (inside := plan.footprint.contains(xyz)).any():
                yield points[inside]

    def _checked(self, node: Node, points: laspy.ScaleAwarePointRecord) -> Floats:
        """Coordinates [3, n] of a node's points, all of which lie in its cube."""
        if len(points) != node.points:
            raise self._refusal(
                f"node {_shown(node)} holds {len(points)} points, the hierarchy says {node.points}"
            )
        stored = np.stack([points.array[axis] for axis in "XYZ"]).astype(np.float64)
        scales, offsets = np.asarray(self.header.scales), np.asarray(self.header.offsets)
        xyz = stored * scales[:, None] + offsets[:, None]
        low, high = self.box(node)
        outside = ((xyz < low[:, None]) | (xyz > high[:, None])).any(axis=0)
        if outside.any():
            raise self._refusal(
                f"{in_number(int(outside.sum()), 'point')} of node {_shown(node)} "
                "outside of its cube: nodes that hold points of the footprint cannot be told"
            )
        return xyz

    def _complete(self) -> None:
        """Raise InputError unless the nodes hold as many points as the header counts."""
        held = sum(node.points for node in self.nodes)
        if held != self.points:
            raise self._refusal(
                f"the header announces {self.points} points, the nodes of its hierarchy hold {held}"
            )
        if any(node.points > MOST_NODE_POINTS for node in self.nodes):
            raise self._refusal(f"a node has more than {MOST_NODE_POINTS} points")

    def _refusal(self, problem: str) -> InputError:
        return InputError(f"truncated or damaged: {problem}", file=self.name, remedy=_WHOLE)

    @abstractmethod
    def _decoded(self, nodes: Sequence[Node]) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points of each of the nodes."""


def good_key(key: tuple[int, int, int, int]) -> bool:
    """Whether there can be a node of that level, x, y, z."""
    return 0 <= key[0] <= MOST_LEVELS and all(0 <= at < 2 ** key[0] for at in key[1:])


def _shown(node: Node) -> str:
    return "-".join(map(str, node.key))


def open_octree(
    location: str | Path, *, allow_hosts: frozenset[str] = frozenset(), patience_s: float = 300.0
) -> Octree:
    """A COPC file (``.copc.laz``), by path, URL (http, https) or stand-in.

    ``allow_hosts``: names of hosts beside the location's own to which its server may redirect;
    ``patience_s``: how long one part of a file is waited for, all tries together.

    Raises InputError: missing, no COPC, damaged, or of a hierarchy that is not complete; what a
    server fails with.
    """
    from .copc import Copc
    from .ranges import open_ranges

    return Copc(open_ranges(location, allow_hosts=allow_hosts, patience_s=patience_s))
