"""Good files of every format that is read, to be damaged."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import rasterio

from .images import pattern
from .las import write_gtx, write_las
from .rpc_texts import rpb_text, rpc_text
from .surveyed_pair import RPCS, SIZES, make_gcps, write_gcps, write_image


@dataclass(frozen=True)
class Case:
    """A good file; ``reader`` says how it is read, ``text`` what is done to it."""

    name: str
    format: str
    reader: str
    file: Path
    text: bool = False
    checksums: bool = False  # of its data, within the format
    options: dict[str, Any] = field(default_factory=dict)

    def cannot_be_told(self, data: bytes, value: Any, good: Any) -> bool:
        """Whether nothing in the damaged file ``data`` tells of the damage.

        Points of LAS and LAZ, pixels of TIFF but for deflate, and RPCs in its tag carry no checksum
        (if the RPC can be one: the control points tell later); steps and
        offsets of LAS that keep the points within two steps of the stated bounds; a control
        point less or a digit changed within the noise of the others, and an RPC that moves no
        place by a pixel after the fit, are as good as the ones before.
        """
        if self.text:
            return float(np.abs(np.subtract(value, good)).max()) < 1.0
        if self.reader == "image" and value[:2] == good[:2]:
            return True
        whole = self.file.read_bytes()
        first, last = (_points_of if self.reader == "lidar" else _pixels_of)(whole)
        if len(whole) != len(data) or self.checksums:
            return False
        changed = np.flatnonzero(np.frombuffer(whole, "u1") != np.frombuffer(data, "u1"))
        hidden = (changed >= first) & (changed < last)
        if self.reader == "lidar":
            hidden |= (changed >= 131) & (changed < 179)  # within two steps: see compare_bounds
        return bool(hidden.any())


def _points_of(las: bytes) -> tuple[int, int]:
    """Bytes of a LAS file that hold points."""
    (first,) = struct.unpack_from("<I", las, 96)
    if las[104] > 63:
        return first + 8, struct.unpack_from("<q", las, first)[0]  # of LAZ: its chunks
    (size,) = struct.unpack_from("<H", las, 105)
    (count,) = (
        struct.unpack_from("<Q", las, 247) if las[25] == 4 else struct.unpack_from("<I", las, 107)
    )
    return first, first + size * count


def _pixels_of(tiff: bytes) -> tuple[int, int]:
    """Bytes of a TIFF written by GDAL, its directory behind them, that hold pixels."""
    return 8, struct.unpack_from("<I", tiff, 4)[0]


def _las_cases(folder: Path) -> list[Case]:
    def case(name: str, kind: str, n: int = 1500, suffix: str = "las", **options) -> Case:
        file = folder / f"{name.replace(' ', '_')}.{suffix}"
        write_las(file, n, **options)
        return Case(name, kind, "lidar", file)

    degrees = np.random.default_rng(1).uniform((114.30, 30.60, 20), (114.31, 30.61, 60), (1500, 3))
    system = pyproj.CRS("EPSG:4979")
    made = [
        case("LAS 1.2", "LAS", pdrf=1, version="1.2"),
        case("LAS 1.4", "LAS", pdrf=6),
        case("LAS degrees", "LAS", xyz=degrees, system=system, scale=1e-7),
        case("LAZ 1.2", "LAZ", 60_000, suffix="laz", pdrf=1, version="1.2"),
        case("LAZ 1.2 small", "LAZ", suffix="laz", pdrf=3, version="1.2"),
        case("LAZ 1.4", "LAZ", 55_000, suffix="laz", pdrf=6),
        case("LAZ 1.4 small", "LAZ", suffix="laz", pdrf=8),
    ]
    late = folder / "LAS_late.las"  # its system stands behind the points
    write_las(late, 1500)
    las = laspy.read(late)
    las.evlrs = laspy.vlrs.vlrlist.VLRList(las.vlrs.get("WktCoordinateSystemVlr"))
    las.vlrs.clear()
    las.write(late)
    return [*made, Case("LAS late", "LAS", "lidar", late)]


def _tiff_cases(folder: Path) -> list[Case]:
    x, y = np.meshgrid(np.arange(160.0), np.arange(128.0))
    grey = pattern(x / 2, y / 2)
    rpc = RPCS["left"]
    text = {
        name.upper(): " ".join(repr(float(v)) for v in np.atleast_1d(value))
        for name, value in rpc.to_dict().items()
    }
    made = []
    for name, dtype, options in (
        ("plain", "uint16", {}),
        ("tiles deflate", "uint16", {"tiled": True, "blockxsize": 64, "blockysize": 64,
                                     "compress": "deflate", "predictor": 2}),
        ("LZW 8 bit", "uint8", {"compress": "lzw"}),
        ("float", "float32", {"compress": "deflate", "predictor": 3}),
        ("float plain", "float32", {"nodata": -9999.0}),
        ("signed", "int16", {"compress": "packbits"}),
        ("complex", "complex64", {}),
    ):  # fmt: skip
        file = folder / f"{name.replace(' ', '_')}.tif"
        values = (grey / 8 if dtype == "uint8" else grey).astype(dtype)
        shape = {"width": 160, "height": 128, "count": 1, "dtype": dtype}
        with rasterio.open(file, "w", driver="GTiff", **shape, **options) as dataset:
            dataset.write(values, 1)
            dataset.update_tags(ns="RPC", ERR_BIAS="-1", ERR_RAND="-1", **text)
        if dtype != "complex64":
            deflate = options.get("compress") == "deflate"
            made.append(Case(f"TIFF {name}", "TIFF", "image", file, checksums=deflate))
    return made


def _text_cases(folder: Path) -> list[Case]:
    for view in ("left", "right"):
        write_image(folder / f"{view}.tif", RPCS[view], SIZES[view])
    gcps = write_gcps(folder / "gcps.csv", make_gcps())
    values = RPCS["left"].to_dict()
    (folder / "left_RPC.TXT").write_text(rpc_text(values))
    apart = folder / "rpb"
    apart.mkdir()
    for name in ("left.tif", "right.tif", "gcps.csv"):
        (apart / name).symlink_to(folder / name)
    (apart / "left.rpb").write_text(rpb_text(values))
    return [
        Case("GCP CSV", "GCP CSV", "gcps", gcps, text=True),
        Case("_RPC.TXT", "RPC text", "rpc", folder / "left_RPC.TXT", text=True),
        Case(".RPB", "RPC text", "rpc", apart / "left.rpb", text=True),
    ]


REAL_OPTIONS = {  # systems that these files do not declare
    "test_semis": {"lidar_crs": "EPSG:2154+5720", "geoid": True},
    "autzen": {"geoid": True},
    "simple_with_page": {"geoid": True},
    "32-1-472-150-76": {"geoid": True},
}


def synthetic_cases(
    folder: Path, lidar: Sequence[Path] = (), images: Sequence[Path] = ()
) -> list[Case]:
    """Good files made in ``folder``, and those given; text and LiDAR more than once in a turn."""
    folder.mkdir(parents=True)
    flat = write_gtx(folder / "flat.gtx", np.full((181, 360), 10.0), -180.0, -90.0, 1.0)
    made = []
    for file in lidar:
        options = next((o for n, o in REAL_OPTIONS.items() if file.name.startswith(n)), {})
        options = dict(options) | ({"geoid": str(flat)} if options.get("geoid") else {})
        kind = "COPC" if ".copc." in file.name else file.suffix[1:].upper()
        made.append(Case(f"{kind} {file.name}", kind, "lidar", file, options=options))
    made += [Case(f"TIFF {f.name}", "TIFF", "image", f) for f in images]
    text = _text_cases(folder)
    made += [*_las_cases(folder), *text, *_tiff_cases(folder), text[0]]
    return made
