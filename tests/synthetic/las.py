"""LAS files, their headers and geoid grids, made by hand."""

from __future__ import annotations

import struct
from datetime import datetime
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import Points, PointStore

UTM = pyproj.CRS("EPSG:32650").to_3d()
WEST, SOUTH = 500_000.0, 3_300_000.0


def write_las(
    path: Path,
    n: int = 3000,
    *,
    pdrf: int = 6,
    version: str = "1.4",
    system: pyproj.CRS | None = UTM,
    side: float = 700.0,
    scale: float = 0.001,
    seed: int = 0,
    xyz: np.ndarray | None = None,
    absolute: bool = False,
    **fields: np.ndarray,
) -> np.ndarray:
    """Random points on a square; returns their coordinates as stored, float64[n, 3].

    ``absolute``: GPS times are.
    """
    rng = np.random.default_rng(seed)
    if xyz is None:
        xyz = np.column_stack(
            [WEST + rng.uniform(0, side, n), SOUTH + rng.uniform(0, side, n), rng.normal(50, 9, n)]
        )
    header = laspy.LasHeader(point_format=pdrf, version=version)
    header.scales = [scale] * 3
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else [0, 0, 0]
    if system is not None:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", system.to_wkt().encode() + b"\0"))
        header.global_encoding.wkt = pdrf >= 6
    las = laspy.LasData(header)
    if absolute:
        las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las.x, las.y, las.z = xyz.T
    values = {
        "classification": np.full(len(xyz), 2, np.uint8),
        "return_number": rng.integers(1, 4, len(xyz)),
        "number_of_returns": np.full(len(xyz), 3),
        **fields,
    }
    for name, value in values.items():
        setattr(las, name, value)
    las.write(path)
    return np.column_stack([las.x, las.y, las.z])


def adjusted(day: np.ndarray) -> np.ndarray:
    """Adjusted standard GPS time (s) of noon of days since 1970-01-01."""
    before = (datetime(1980, 1, 6) - datetime(1970, 1, 1)).days
    return (day - before + 0.5) * 86400.0 - 1e9


def everything(store: PointStore) -> Points:
    return store.query(*store.bounds[:4])


# ------------------------------------------------------------------ refused by name


def refused(file: Path, match: str, **arguments) -> str:
    """Ingest must fail with a message that names the file, and leave nothing behind."""
    store = file.with_name("refused.points")
    with pytest.raises(InputError, match=match) as error:
        ingest(file, store, **arguments)
    assert file.name in str(error.value)
    assert "Remedy: " in str(error.value)
    assert not list(file.parent.glob("refused.points*"))
    return str(error.value)


FT, US_FT = 0.3048, 1200 / 3937
UTM_10 = pyproj.CRS("EPSG:32610")
UTM_WKT1 = UTM_10.to_wkt("WKT1_GDAL")
NAVD88_FTUS = (
    'VERT_CS["NAVD88 height (ftUS)",VERT_DATUM["North American Vertical Datum 1988",2005],'
    'UNIT["US survey foot",0.304800609601219],AXIS["Up",UP]]'
)


def header_of(
    wkt: str = "",
    keys: list[tuple[int, int, int, int]] | None = None,
    *,
    low: tuple[float, float, float] = (500000, 4800000, 0),
    wkt_bit: bool = True,
) -> laspy.LasHeader:
    """Header with a box of 100 units from ``low``, WKT and GeoKeys as given."""
    header = laspy.LasHeader(point_format=6 if wkt_bit else 1, version="1.4")
    header.global_encoding.wkt = wkt_bit
    header.mins, header.maxs = np.array(low, float), np.array(low, float) + 100
    if wkt:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0"))
    if keys:
        shorts = [1, 1, 0, len(keys)] + [value for key in keys for value in key]
        data = struct.pack(f"<{len(shorts)}H", *shorts)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
    return header


def write_gtx(
    path: Path, values: np.ndarray, west: float, south: float, step: float, nodata: float = -88.8888
) -> Path:
    """GTX grid (NOAA VDatum's format, big-endian) of [row, col] values, southernmost row first."""
    values = np.where(np.isfinite(values), values, nodata)
    head = struct.pack(">4d2i", south, west, step, step, *values.shape)
    path.write_bytes(head + values.astype(">f4").tobytes())
    return path
