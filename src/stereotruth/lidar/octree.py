"""Opening an octree of points, of which a footprint is read: see :mod:`.octree_nodes`."""

from __future__ import annotations

from pathlib import Path

from .copc import Copc
from .octree_nodes import Octree
from .ranges import open_ranges


def open_octree(
    location: str | Path, *, allow_hosts: frozenset[str] = frozenset(), patience_s: float = 300.0
) -> Octree:
    """A COPC file (``.copc.laz``), by path, URL (http, https) or stand-in.

    ``allow_hosts``: names of hosts beside the location's own to which its server may redirect;
    ``patience_s``: how long one part of a file is waited for, all tries together.

    Raises InputError: missing, no COPC, damaged, or of a hierarchy that is not complete; what a
    server fails with.
    """
    return Copc(open_ranges(location, allow_hosts=allow_hosts, patience_s=patience_s))
