"""A surface store: the triangles of a site's ground, block by block, for all images that show it.

A folder:

=================  =========================================================================
``blocks/R_C.npz`` triangles whose first vertex lies in block (R, C) of ``side`` ground cells:
                   records of :data:`ARRAYS`, not compressed, each array with a checksum
``surface.json``   ``scale`` of the surface, ``side``, ``blocks``: of each that has triangles its
                   number, the box of its vertices and the SHA-256 of its file; and a digest
=================  =========================================================================

Blocks lie on the global lattice. What a window of an image shows follows from the blocks whose
boxes it sees (:meth:`SurfaceStore.blocks`), taken in their order.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_magic
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.kernels import kernel
from ..core.products.files import read_sealed
from ..lidar.lattice import LATTICE_DEG
from .region import Region
from .rough_tops import RoughTops
from .scale import PART, SurfaceScale
from .surface import GroundSurface
from .vertices import Vertices

FORMAT = 3
ATTRIBUTES, BLOCKS = "surface.json", "blocks"
CORNER = ("corner", "<i4", 3)
ARRAYS = {  # of records
    "vertices": np.dtype(
        [("lon", "<i4"), ("lat", "<i4"), ("height", "<i4"),
         ("count", "<u2"), ("day", "<u2"), ("surface_class", "u1")]
    ),
    "facets": np.dtype([CORNER, ("variance", "<f4"), ("bulge", "<f4")]),
    "whole": np.dtype([CORNER]),
    "strips": np.dtype([CORNER, ("height_range", "<i4", 2)]),
    "tops": np.dtype([CORNER, ("residual", "<f4"), ("is_gentle", "?")]),
}  # fmt: skip
TRIANGLES = "facets", "whole", "strips", "tops"  # the arrays whose records have corners
CONTENTS = {
    "vertices": "lon, lat from the block's south-west corner, 1e-9 degree; height above the WGS 84 "
    "ellipsoid, 1e-4 m; count of points that it is the mean of, 65535 stands for more, too; day "
    "since 1970-01-01 (0 not known) and surface_class (ASPRS) of the highest of these",
    "facets": "corner: vertices; variance of a point's height there, (1e-4 m)²; bulge of the "
    "surface above it, 1e-4 m",
    "whole": "undecided triangles; corner: vertices",
    "strips": "triangles along breaklines; corner: vertices; height_range: lowest and highest "
    "surface in each, 1e-4 m",
    "tops": "triangles of rough surfaces' tops; corner: vertices; residual: rms of the tops to the "
    "planes beside, 1e-4 m, NaN for none; is_gentle: neither steep nor alone",
}
Box = tuple[float, float, float, float]


class Block(NamedTuple):
    """A block that has triangles: number (row, col), box of its vertices (west, south, east, north,
    lattice steps), heights of these (lowest, highest, steps), SHA-256 of its file."""

    row: int
    col: int
    box: tuple[int, int, int, int]
    heights: tuple[int, int]
    sha256: str

    @property
    def name(self) -> str:
        """Of its file, without the suffix."""
        return f"{self.row}_{self.col}"


def write_block(path: Path, surface: GroundSurface, corner: tuple[int, int]) -> dict[str, Any]:
    """Write the triangles of a block whose south-west ``corner`` is at (lon, lat), lattice steps;
    its ``box`` and ``heights``."""
    whole = surface.undecided[: surface.whole]
    strip = surface.undecided[surface.strips]
    triangles = [surface.facet, whole, strip, surface.tops.corner]
    used = np.zeros(surface.vertices.x.size, np.bool_)
    for corners in triangles:
        used[corners.reshape(-1)] = True
    taken = np.flatnonzero(used)
    number = np.empty(used.size, np.int32)  # of those that are used, which are few of a group's
    number[taken] = np.arange(taken.size, dtype=np.int32)
    facet, whole, strip, top = (number[corners] for corners in triangles)
    vertices = surface.vertices.taken(taken)
    values = {
        "vertices": {
            "lon": vertices.lon_q - corner[0],
            "lat": vertices.lat_q - corner[1],
            "height": vertices.h_q,
            "count": np.minimum(vertices.count, 65535),
            "day": vertices.day,
            "surface_class": vertices.surface_class,
        },
        "facets": {"corner": facet, "variance": surface.variance, "bulge": surface.bulge},
        "whole": {"corner": whole},
        "strips": {"corner": strip, "height_range": surface.height_range[surface.strips]},
        "tops": {
            "corner": top,
            "residual": surface.tops.residual,
            "is_gentle": surface.tops.is_gentle,
        },
    }
    np.savez(path, **{name: _records(kind, values[name]) for name, kind in ARRAYS.items()})
    lon, lat, h = vertices.lon_q, vertices.lat_q, vertices.h_q
    box = [int(value) for value in (lon.min(), lat.min(), lon.max(), lat.max())]
    return {"box": box, "heights": [int(h.min()), int(h.max())]}


def _records(kind: np.dtype, values: Mapping[str, NDArray]) -> NDArray[np.void]:
    """Records [n] of a ``kind`` with the ``values`` [n] of its fields."""
    out = np.empty(len(next(iter(values.values()))), kind)
    for name, of_field in values.items():
        out[name] = of_field
    return out


def _array(file: bytes) -> NDArray[np.void]:
    """The records in an array's ``file``, as a view: NumPy's own reader would copy them."""
    stream = io.BytesIO(file)
    if read_magic(stream) != (1, 0):
        raise ValueError("another version of NumPy's format")
    shape, _, kind = read_array_header_1_0(stream)
    return np.frombuffer(file, kind, offset=stream.tell()).reshape(shape)


@dataclass(frozen=True, eq=False)
class WindowSurface:
    """What a window may see of a surface: the ``blocks`` of a ``store``, and all their
    ``vertices``, of which ``x``, ``y`` count from ``first``, (lon, lat) number of a cell."""

    store: SurfaceStore
    blocks: tuple[Block, ...]
    vertices: Vertices
    first: tuple[int, int]

    def surface(self, region: Region) -> GroundSurface:
        """The triangles that touch a ``region``, with all vertices."""
        parts: dict[str, list[NDArray[np.void]]] = {name: [] for name in TRIANGLES}
        start = 0
        for block in self.blocks:
            for name, triangles in self.store.arrays(block, TRIANGLES).items():
                touching = region.touching(self.vertices, triangles["corner"], start)
                taken = triangles.take(np.flatnonzero(touching))  # a fourth of a mask's time
                taken["corner"] += np.int32(start)
                parts[name].append(taken)
            start += self.store.sizes[block.name]
        return _surface(self.vertices, {name: np.concatenate(part) for name, part in parts.items()})


@kernel
def _height_range(h: NDArray[np.int64], corner: NDArray[np.int32]) -> NDArray[np.int64]:
    """Least and greatest height [n, 2] of the vertices of triangles [n, 3]."""
    out = np.empty((len(corner), 2), np.int64)
    for t in range(len(corner)):
        a, b, c = h[corner[t, 0]], h[corner[t, 1]], h[corner[t, 2]]
        out[t, 0], out[t, 1] = min(a, b, c), max(a, b, c)
    return out


def _surface(vertices: Vertices, triangles: Mapping[str, NDArray[np.void]]) -> GroundSurface:
    """Of records by the names of ARRAYS."""

    def field(name: str, value: str) -> NDArray:
        return np.ascontiguousarray(triangles[name][value])

    facet, whole, strip, top = (field(name, "corner") for name in TRIANGLES)
    top_range, residual = _height_range(vertices.h_q, top), field("tops", "residual")
    heights = _height_range(vertices.h_q, whole), field("strips", "height_range").astype(np.int64)
    undecided = np.concatenate([whole, strip])
    return GroundSurface(
        vertices=vertices,
        facet=facet,
        variance=field("facets", "variance"),
        bulge=field("facets", "bulge"),
        undecided=undecided,
        height_range=np.concatenate(heights),
        whole=len(whole),
        tops=RoughTops(
            top,
            residual.astype(np.float64),
            top_range[:, 1] - top_range[:, 0],
            field("tops", "is_gentle"),
        ),
        facet_origin=facet[:, 0],
        undecided_origin=undecided[:, 0],
    )


class SurfaceStore:
    """A finished surface store, open for windows. Raises InputError if it is missing or damaged."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self.attrs = read_sealed(self.path / ATTRIBUTES)
        except FileNotFoundError as error:
            raise InputError(
                "no such surface", file=self.path, remedy="run the stage that makes it"
            ) from error
        if self.attrs.get("kind") != "surface" or self.attrs.get("format") != FORMAT:
            raise InputError(
                f"no surface of format {FORMAT}",
                file=self.path,
                remedy="delete it and run the workflow again",
            )
        scale = dict(self.attrs["scale"])
        self.scale = SurfaceScale(**scale | {"cell": tuple(scale["cell"])})
        self.side = int(self.attrs["side"])
        self.every = tuple(
            Block(*number, tuple(box), tuple(heights), sha256)
            for *number, box, heights, sha256 in self.attrs["blocks"]
        )
        self.sizes: dict[str, int] = {}

    @property
    def points_per_m2(self) -> float:
        """Of the points that it is made of, over the ground that they cover."""
        return self.attrs["points_per_m2"]

    def blocks(self, box: Box) -> tuple[Block, ...]:
        """The blocks that may have triangles in a box (west, south, east, north, degrees)."""
        west, south, east, north = (edge / LATTICE_DEG for edge in box)
        return tuple(
            block
            for block in self.every
            if block.box[0] <= east
            and block.box[2] >= west
            and block.box[1] <= north
            and block.box[3] >= south
        )

    def arrays(self, block: Block, names: Sequence[str]) -> dict[str, NDArray[np.void]]:
        """Records of a block by the names of their arrays. Raises InputError if they are not what
        was written."""
        file = self.path / BLOCKS / f"{block.name}.npz"
        try:
            with zipfile.ZipFile(file) as archive:
                return {name: _array(archive.read(f"{name}.npy")) for name in names}
        except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
            raise InputError(
                "damaged: it is not what was written",
                file=file,
                remedy=f"delete {self.path} and run the workflow again",
            ) from error

    def positions(self, block: Block, vertices: NDArray[np.void]) -> tuple[NDArray[np.int64], ...]:
        """Longitude, latitude and height (lattice steps) of a block's vertices."""
        col, row = (number * self.side for number in (block.col, block.row))
        lon = vertices["lon"] + np.int64(col * self.scale.cell[0])
        lat = vertices["lat"] + np.int64(row * self.scale.cell[1])
        return lon, lat, vertices["height"].astype(np.int64)

    def window(self, blocks: Sequence[Block]) -> WindowSurface:
        """Of some blocks, one at least."""
        cell = self.scale.cell
        corners = np.array([block.box[:2] for block in blocks]).min(axis=0)
        first = tuple(int(q) // side for q, side in zip(corners, cell))
        parts = []
        for block in blocks:
            a = self.arrays(block, ["vertices"])["vertices"]
            lon, lat, h = self.positions(block, a)
            x = (lon - first[0] * cell[0]) * PART // cell[0]
            y = (lat - first[1] * cell[1]) * PART // cell[1]
            count = a["count"].astype(np.int32)
            parts.append(Vertices(lon, lat, h, x, y, a["surface_class"], count, a["day"]))
            self.sizes[block.name] = lon.size
        vertices = Vertices(*(np.concatenate(values) for values in zip(*parts)))
        return WindowSurface(self, tuple(blocks), vertices, first)
