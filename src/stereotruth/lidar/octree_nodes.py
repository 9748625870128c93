"""Points of an octree (COPC) that lie in a footprint, with checks that none is missing.

An octree keeps its points in nodes: cubes of half the side of their parent's. Which nodes may hold
points of a footprint follows from the octree's own cube, never from the header's bounds, which
writers get wrong. Before any point is read, the counts of all nodes of the hierarchy must add up to
the header's count. While points are read, each node must hold as many as the hierarchy says, all of
them within the node's cube: else other nodes may hold points of the footprint too, and the file is
refused. One fault cannot be told without reading all: a hierarchy that gives the points of a node
to a smaller one inside it, outside of the footprint, and the other way round. Source: COPC 1.0
(Hobu), "Hierarchy".
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import laspy
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, in_number
from .footprint import Footprint

Floats = NDArray[np.float64]

MOST_LEVELS = 30  # keys of nodes stay within 32 bits
MOST_NODES = 4_000_000  # of a hierarchy, which is kept in memory
MOST_NODE_POINTS = 5_000_000  # decoded at once
STEPS_OUTSIDE = 2  # of the stored coordinates, that a point may lie outside of its node's cube
_WHOLE = "have the file written again, or download it and name the copy to read it whole"


@dataclass(frozen=True)
class Node:
    """A node with points: its first byte in the file, and the bytes of its compressed points."""

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
        """Bytes of all nodes."""
        return sum(node.bytes for node in self.nodes)


class Octree(ABC):
    """An octree of points; made by :func:`.octree.open_octree`.

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
