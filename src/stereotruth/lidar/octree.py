"""Opening an octree of points, of which a footprint is read: see :mod:`.octree_nodes`."""

from __future__ import annotations

from pathlib import Path

from .copc import Copc
from .octree_nodes import Octree
from .range_copies import open_ranges


def open_octree(
    location: str | Path, *, allow_hosts: frozenset[str] = frozenset(), patience_s: float = 300.0
) -> Octree:
    """A COPC file (``.copc.laz``) or EPT (``ept.json``), by path, URL (http, https) or stand-in.

    ``allow_hosts``: names of hosts beside the location's own to which its server may redirect;
    ``patience_s``: how long one part of a file is waited for, all tries together.

    Raises InputError: missing, neither of both, damaged, or of a hierarchy that is not complete;
    what a server fails with.
    """
    if str(location).rpartition("/")[2].lower() == "ept.json":
        from .ept import Ept  # which few scenes have

        return Ept(location, allow_hosts=allow_hosts, patience_s=patience_s)
    return Copc(open_ranges(location, allow_hosts=allow_hosts, patience_s=patience_s))
