"""What stores on the disk hold, and a job that ends in the middle."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from stereotruth.lidar.lattice import Footprint
from stereotruth.lidar.point_store import PointStore


def tree_digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes())
    return digest.hexdigest()


class Killed(BaseException):
    """As if the process had ended here: nothing of the package catches it."""


def tree(path: Path) -> dict[str, str]:
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


def part_of(whole: PointStore, footprint: Footprint) -> tuple[bytes, bytes]:
    """Points and cells of a whole file's store that lie in a footprint."""
    at = np.stack([whole.cell_row - footprint.row, whole.cell_col - footprint.col])
    good = ((at >= 0) & (at < np.array([footprint.held.shape]).T)).all(axis=0)
    good[good] = footprint.held[tuple(at[:, good])]
    points, cells = (np.load(whole.path / f"{name}.npy") for name in ("points", "cells"))
    kept = np.repeat(good, whole.cell_counts)
    cells = cells[good]
    cells["first"] = np.cumsum(whole.cell_counts[good]) - whole.cell_counts[good]
    return points[kept].tobytes(), cells.tobytes()


def content_of(store: PointStore) -> tuple[bytes, bytes]:
    return tuple(np.load(store.path / f"{name}.npy").tobytes() for name in ("points", "cells"))
