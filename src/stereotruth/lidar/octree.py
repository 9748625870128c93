"""Points of an octree (COPC, EPT) that lie in a footprint, with checks that none is missing.

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
from collections.abc import Callable, Iterator
from functools import cached_property

import laspy
import numpy as np
from laspy.compression import DecompressionSelection
from numpy.typing import NDArray

from ..core.errors import InputError, in_number

Floats = NDArray[np.float64]
Touches = Callable[[Floats, Floats], NDArray[np.bool_]]
"""Which boxes, by lowest and highest corners [n, 3], may hold points that are wanted."""

NODE = np.dtype([("key", "<i4", 4), ("start", "<i8"), ("bytes", "<i8"), ("points", "<i8")])
"""A node: level, x, y, z; its first byte in the file, the bytes of its compressed points, and how
many these are. In EPT, where a node is a file, the bytes are an estimate."""

FIELDS = (  # that are decoded
    DecompressionSelection.XY_RETURNS_CHANNEL
    | DecompressionSelection.Z
    | DecompressionSelection.CLASSIFICATION
    | DecompressionSelection.FLAGS
    | DecompressionSelection.POINT_SOURCE_ID
    | DecompressionSelection.GPS_TIME
)
MOST_LEVELS = 30  # keys of nodes stay within 32 bits
MOST_NODES = 4_000_000  # of a hierarchy, which is kept in memory
MOST_NODE_POINTS = 5_000_000  # decoded at once
BATCH_BYTES = 16 << 20  # of nodes that are fetched together
STEPS_OUTSIDE = 2  # of the stored coordinates, that a point may lie outside of its node's cube


class Octree(ABC):
    """An octree of points; made by :func:`.point_files.open_octree`.

    ``name``: path or URL; ``header``: coordinate system, scales and offsets, point format, count
    and stated bounds of the whole; ``nodes``: all that have points [n] (:data:`NODE`), in the order
    of the file; ``low``, ``side``: lowest corner [3] and side of the octree's cube.
    """

    name: str
    header: laspy.LasHeader
    nodes: np.ndarray
    low: Floats
    side: float

    def boxes(self, nodes: np.ndarray) -> tuple[Floats, Floats]:
        """Lowest and highest corners [n, 3] of nodes' cubes, with what rounding may add to them."""
        keys = nodes["key"].astype(np.float64)
        side = self.side / 2.0 ** keys[:, :1]
        low = self.low + keys[:, 1:] * side
        slack = STEPS_OUTSIDE * np.asarray(self.header.scales)
        return low - slack, low + side + slack

    def plan(self, touches: Touches | None) -> NDArray[np.intp]:
        """Which of the nodes, by number, are to be read for a footprint; all of them for None.

        Those that may hold points of it; and, unless there is none, the root and one of the finest,
        which prove the octree's cube.

        Raises InputError if the header's bounds and the octree's cube contradict each other about
        whether there are points in the footprint.
        """
        if touches is None:
            return np.arange(len(self.nodes))
        wanted = np.array(touches(*self.boxes(self.nodes)), bool)
        if not wanted.any():
            bounds = np.array([[self.header.mins], [self.header.maxs]])
            beyond = (bounds[0, 0] < self.low) | (bounds[1, 0] > self.low + self.side)
            if np.isfinite(bounds).all() and beyond.any() and touches(*bounds)[0]:
                raise self._refusal(
                    "the header's bounds reach out of the octree's cube, into the footprint"
                )
            return np.empty(0, np.intp)
        level = self.nodes["key"][:, 0]
        if level[wanted].max() < level.max():
            wanted[np.argmax(level)] = True
        wanted[min(self._number_of.items())[1]] = True
        return np.flatnonzero(wanted)

    def read(self, numbers: NDArray[np.intp]) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points of the nodes of these numbers, node by node in the order of the file.

        Of each point X, Y, Z, returns, class, flags and GPS time are decoded.

        Raises InputError: a node of other points than the hierarchy says, or points out of its
        cube; what a server or a damaged file fails with.
        """
        looked, wanted = set(numbers.tolist()), True
        while numbers.size:
            doubted: set[int] = set()
            for node, points in zip(self.nodes[numbers], self._decoded(numbers), strict=True):
                xyz = self._checked(node, points)
                doubted |= self._below(int(node["key"][0]), xyz)
                if wanted:
                    yield points
            numbers, wanted = np.array(sorted(doubted - looked), np.intp), False
            looked |= doubted

    def _below(self, level: int, xyz: Floats) -> set[int]:
        """Numbers of the nodes below a level whose cubes hold all of some points [3, n]."""
        low, high = xyz.min(axis=1) - self.low, xyz.max(axis=1) - self.low
        slack = np.minimum(STEPS_OUTSIDE * np.asarray(self.header.scales), (high - low) / 2)
        corners = np.stack([low + slack, high - slack])  # a point on a face may be either node's
        inside: set[int] = set()
        for deeper in range(level + 1, int(self.nodes["key"][:, 0].max()) + 1):
            first, last = np.floor(corners / (self.side / 2.0**deeper))
            if (first != last).any():
                break
            if (number := self._number_of.get((deeper, *map(int, first)))) is not None:
                inside.add(number)
        return inside

    @cached_property
    def _number_of(self) -> dict[tuple[int, ...], int]:
        """Numbers of the nodes by key."""
        return {tuple(key): number for number, key in enumerate(self.nodes["key"].tolist())}

    def _checked(self, node: np.void, points: laspy.ScaleAwarePointRecord) -> Floats:
        """Coordinates [3, n] of a node's points, all of which lie in its cube."""
        if len(points) != node["points"]:
            raise self._refusal(
                f"node {shown(node)} holds {len(points)} points, the hierarchy says "
                f"{node['points']}"
            )
        stored = np.stack([points.array[axis] for axis in "XYZ"]).astype(np.float64)
        scales, offsets = np.asarray(self.header.scales), np.asarray(self.header.offsets)
        xyz = stored * scales[:, None] + offsets[:, None]
        low, high = (corner[0, :, None] for corner in self.boxes(node.reshape(1)))
        outside = ((xyz < low) | (xyz > high)).any(axis=0)
        if outside.any():
            raise self._outside(int(outside.sum()), node)
        return xyz

    def _refuse_incomplete(self) -> None:
        """Raise InputError unless there is an octree of as many points as the header counts."""
        level, *at = self.nodes["key"].T.astype(np.int64)
        good = (level >= 0) & (level <= MOST_LEVELS) & (np.array(at) >= 0).all(axis=0)
        good &= (np.array(at) < 2 ** np.clip(level, 0, MOST_LEVELS)).all(axis=0)
        if not good.all():
            raise self._refusal(f"its hierarchy has a node {shown(self.nodes[np.argmin(good)])}")
        if len(self._number_of) < len(self.nodes):
            raise self._refusal("a node stands twice in its hierarchy")
        held, wanted = int(self.nodes["points"].sum()), int(self.header.point_count)
        if held != wanted:
            raise self._refusal(
                f"the header announces {wanted} points, the nodes of its hierarchy hold {held}"
            )
        if (self.nodes["points"] > MOST_NODE_POINTS).any():
            raise self._refusal(f"a node has more than {MOST_NODE_POINTS} points")

    def _outside(self, count: int, node: np.void) -> InputError:
        return self._refusal(
            f"{in_number(count, 'point')}, as of node {shown(node)}, "
            "outside of its cube: nodes that hold points of the footprint cannot be told"
        )

    def _refusal(self, problem: str) -> InputError:
        return InputError(
            f"truncated or damaged: {problem}",
            file=self.name,
            remedy="have the file written again, or download it and name the copy to read it whole",
        )

    @abstractmethod
    def _decoded(self, numbers: NDArray[np.intp]) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points of each of the nodes."""


def shown(node: np.void) -> str:
    """The key of a node, as EPT names its file."""
    return "-".join(map(str, node["key"]))
