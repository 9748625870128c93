"""COPC files that copclib writes: of other hands than what reads them here."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np

INFO_AT = 375 + 54


def write_copc(
    file: Path,
    las: laspy.LasData,
    levels: int = 4,
    page_levels: Sequence[int] = (2,),
    seed: int = 0,
) -> Path:
    """The points of a LAS file in formats 6 to 8 as COPC.

    ``page_levels``: at which the nodes begin a page of the hierarchy of their own; several of them
    nest pages. Half of the nodes of level 1 stay without points, as parents of some.
    """
    import copclib

    xyz = np.stack([las.x, las.y, las.z], axis=1)
    low, side = xyz.min(axis=0), float(np.ptp(xyz, axis=0).max()) * 1.001
    rng = np.random.default_rng(seed)
    shares = 4.0 ** np.arange(levels)
    level = rng.choice(levels, len(xyz), p=shares / shares.sum())
    place = np.floor((xyz - low) / (side / 2.0**level)[:, None]).astype(int)
    level[(level == 1) & (place.sum(axis=1) % 2 == 1)] = 0
    place[level == 0] = 0
    header, wkt = las.header, las.header.parse_crs().to_wkt()
    scale, offset = (copclib.Vector3(*map(float, v)) for v in (header.scales, header.offsets))
    form = header.point_format.id
    settings = copclib.CopcConfigWriter(form, scale, offset, wkt)
    half = side / 2
    settings.copc_info.center_x, settings.copc_info.center_y, settings.copc_info.center_z = (
        float(v) for v in low + half
    )
    settings.copc_info.halfsize = half
    settings.copc_info.spacing = 10.0
    settings.las_header.min = copclib.Vector3(*map(float, low))
    settings.las_header.max = copclib.Vector3(*map(float, xyz.max(axis=0)))
    writer = copclib.FileWriter(str(file), settings)
    keys = np.column_stack([level, place])
    for key in np.unique(keys, axis=0):
        inside = (keys == key).all(axis=1)
        records = las.points.array[inside].tobytes()
        tops = [one for one in page_levels if one <= key[0]]
        up = int(key[0]) - max(tops, default=0)
        page = copclib.VoxelKey(int(key[0]) - up, *(int(v) >> up for v in key[1:]))
        points = copclib.VectorChar(np.frombuffer(records, np.int8))
        writer.AddNode(copclib.VoxelKey(*map(int, key)), points, page)
    writer.Close()
    return file


def page_count(file: Path) -> int:
    """How many pages the hierarchy has, by its entries of -1."""
    content = file.read_bytes()
    start, size = struct.unpack_from("<2Q", content, INFO_AT + 40)
    pages, waiting = 0, [(start, size)]
    while waiting:
        start, size = waiting.pop()
        pages += 1
        for at in range(start, start + size, 32):
            *_, first, length, points = struct.unpack_from("<4iQii", content, at)
            if points == -1:
                waiting.append((first, length))
    return pages
