"""Points of an octree (COPC) that lie in a footprint, with checks that none is missing.

An octree keeps its points in nodes: cubes of half the side of their parent's. Which nodes may hold
points of a footprint follows from the octree's own cube, never from the header's bounds, which
writers get wrong. Before any point is read, the counts of all nodes of the hierarchy must add up to
the header's count. While points are read, each node must hold as many as the hierarchy says, all of
them within the node's cube: else other nodes may hold points of the footprint too, and the file is
refused. Where all points of a node lie in the cube of one below it, the hierarchy may have
exchanged the two: the other is read as well, and must keep to its own cube. Source: COPC 1.0
(Hobu), "Hierarchy".
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import laspy
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, in_number

Floats = NDArray[np.float64]
Touches = Callable[[Floats, Floats], NDArray[np.bool_]]
"""Which boxes, by lowest and highest corners [n, 3], may hold points that are wanted."""

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

    def boxes(self, nodes: Sequence[Node]) -> tuple[Floats, Floats]:
        """Lowest and highest corners [n, 3] of nodes' cubes, with what rounding may add to them."""
        keys = np.array([node.key for node in nodes], np.float64).reshape(-1, 4)
        side = self.side / 2.0 ** keys[:, :1]
        low = self.low + keys[:, 1:] * side
        slack = STEPS_OUTSIDE * np.asarray(self.header.scales)
        return low - slack, low + side + slack

    def plan(self, touches: Touches | None) -> NodePlan:
        """The nodes to read for a footprint; all of them for None.

        Raises InputError if the header's bounds and the octree's cube contradict each other about
        whether there are points in the footprint.
        """
        if touches is None:
            return NodePlan(self.nodes, len(self.nodes))
        which = touches(*self.boxes(self.nodes))
        touched = [node for node, wanted in zip(self.nodes, which.tolist()) if wanted]
        if not touched:
            bounds = np.array([[self.header.mins], [self.header.maxs]])
            beyond = (bounds[0, 0] < self.low) | (bounds[1, 0] > self.low + self.side)
            if np.isfinite(bounds).all() and beyond.any() and touches(*bounds)[0]:
                raise self._refusal(
                    "the header's bounds reach out of the octree's cube, into the footprint"
                )
            return NodePlan((), 0)
        deepest = max(node.key[0] for node in self.nodes)
        chosen = {node.key for node in touched}
        if max(node.key[0] for node in touched) < deepest:
            chosen.add(next(node.key for node in self.nodes if node.key[0] == deepest))
        chosen.add(min(self.nodes, key=lambda node: node.key).key)
        nodes = tuple(node for node in self.nodes if node.key in chosen)
        return NodePlan(nodes, len(touched))

    def read(self, plan: NodePlan) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points of the plan's nodes, node by node in the order of the file.

        Of each point X, Y, Z, returns, class, flags and GPS time are decoded.

        Raises InputError: a node of other points than the hierarchy says, or points out of its
        cube; what a server or a damaged file fails with.
        """
        by_key = {node.key: node for node in self.nodes}
        doubted: dict[tuple[int, int, int, int], Node] = {}
        for node, points in zip(plan.nodes, self._decoded(plan.nodes), strict=True):
            xyz = self._checked(node, points)
            doubted |= self._below(node, xyz, by_key)
            yield points
        looked = {node.key for node in plan.nodes}
        while others := [node for key, node in doubted.items() if key not in looked]:
            looked |= {node.key for node in others}
            for node, points in zip(others, self._decoded(others), strict=True):
                doubted |= self._below(node, self._checked(node, points), by_key)

    def _below(
        self,
        node: Node,
        xyz: Floats,
        by_key: Mapping[tuple[int, int, int, int], Node],
    ) -> dict[tuple[int, int, int, int], Node]:
        """The nodes below one whose cube holds all of its points."""
        low, high = xyz.min(axis=1) - self.low, xyz.max(axis=1) - self.low
        slack = np.minimum(STEPS_OUTSIDE * np.asarray(self.header.scales), (high - low) / 2)
        low, high = low + slack, high - slack  # a point on a face may be either node's
        inside = {}
        for level in range(node.key[0] + 1, self._deepest + 1):
            side = self.side / 2.0**level
            first, last = np.floor(low / side), np.floor(high / side)
            if (first != last).any():
                break
            key = (level, *map(int, first))
            if key in by_key:
                inside[key] = by_key[key]
        return inside

    @cached_property
    def _deepest(self) -> int:
        return max(node.key[0] for node in self.nodes)

    def _checked(self, node: Node, points: laspy.ScaleAwarePointRecord) -> Floats:
        """Coordinates [3, n] of a node's points, all of which lie in its cube."""
        if len(points) != node.points:
            raise self._refusal(
                f"node {_shown(node)} holds {len(points)} points, the hierarchy says {node.points}"
            )
        stored = np.stack([points.array[axis] for axis in "XYZ"]).astype(np.float64)
        scales, offsets = np.asarray(self.header.scales), np.asarray(self.header.offsets)
        xyz = stored * scales[:, None] + offsets[:, None]
        low, high = (corner[0, :, None] for corner in self.boxes([node]))
        outside = ((xyz < low) | (xyz > high)).any(axis=0)
        if outside.any():
            raise self._outside(int(outside.sum()), node)
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

    def _outside(self, count: int, node: Node) -> InputError:
        return self._refusal(
            f"{in_number(count, 'point')}, as of node {_shown(node)}, "
            "outside of its cube: nodes that hold points of the footprint cannot be told"
        )

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
