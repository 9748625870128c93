"""Given RPCs as cameras of a twin: read, moved over its place, cropped, turned round.

RPCs tell where a ground point appears; rays need the way back. A camera of :mod:`.rpc_cameras` is
fitted to them; the camera, and not the RPCs, is the truth then.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio

from ..errors import InputError
from .geodesy import LocalFrame
from .rpc_cameras import (
    COL0,
    COLS,
    GROUND_X,
    GROUND_Y,
    INVERSE,
    PER_COL,
    PER_LINE,
    ROW0,
    ROWS,
    SIZE,
    STATION_X,
    STATION_Y,
    STATION_Z,
)
from .rpcs import terms

STATIONS_M = 2e5, 4e7  # heights of satellites
MISFIT_PX = 0.02
NAMES = ("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF", "LINE_SCALE", "SAMP_SCALE",
         "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE")  # fmt: skip
RATIOS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")


@dataclass(frozen=True)
class GivenRPC:
    """RPCs of a ``file``.

    ``numbers`` in the order of NAMES, ``coefficients`` float64[4, 20] in that of RATIOS.
    """

    file: Path
    numbers: np.ndarray
    coefficients: np.ndarray

    def project(self, lonlath: np.ndarray) -> np.ndarray:
        """Image coordinates [n, 2] (col, row) of longitude, latitude, height [n, 3]."""
        line_off, samp_off, lat_off, lon_off, h_off, line_s, samp_s, lat_s, lon_s, h_s = (
            self.numbers
        )
        a = terms(
            (lonlath[:, 0] - lon_off) / lon_s,
            (lonlath[:, 1] - lat_off) / lat_s,
            (lonlath[:, 2] - h_off) / h_s,
        )
        line_num, line_den, samp_num, samp_den = (a @ c for c in self.coefficients)
        return np.column_stack([
            samp_num / samp_den * samp_s + samp_off, line_num / line_den * line_s + line_off
        ])  # fmt: skip

    def over(self, lon: float, lat: float, height: float) -> GivenRPC:
        """These RPCs, or, if they are of another place, the same moved over this one.

        Longitudes are stretched as the meridians draw together, so that metres stay metres.
        """
        _, _, lat_off, lon_off, h_off, _, _, lat_s, lon_s, h_s = self.numbers
        off = (lon - lon_off) / lon_s, (lat - lat_off) / lat_s, (height - h_off) / h_s
        if max(map(abs, off)) <= 1.0:
            return self
        numbers = self.numbers.copy()
        numbers[2:5] = lat, lon, height
        numbers[8] *= np.cos(np.radians(lat_off)) / np.cos(np.radians(lat))
        return replace(self, numbers=numbers)

    def cropped(self, col: int, row: int) -> GivenRPC:
        """The RPCs of the image from a column and a row on."""
        numbers = self.numbers.copy()
        numbers[:2] -= row, col
        return replace(self, numbers=numbers)


def read_rpc(file: str | Path) -> GivenRPC:
    """RPCs of an image, by GDAL, or of a text in the form of ``_RPC.TXT``.

    Raises InputError if the file has none.
    """
    file = Path(file)
    if not file.is_file():
        raise InputError("there is no such file", file=file, remedy="name images with RPCs")
    try:
        return GivenRPC(file, *_of_text(file.read_text(encoding="ascii")))
    except (UnicodeDecodeError, KeyError, ValueError):
        pass
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(file) as source:
                given = source.rpcs
    except rasterio.errors.RasterioError:
        given = None
    if given is None:
        raise InputError(
            "has no RPCs", file=file, remedy="name images with RPCs, or texts of RPCs (_RPC.TXT)"
        )
    return GivenRPC(
        file,
        np.array([
            given.line_off, given.samp_off, given.lat_off, given.long_off, given.height_off,
            given.line_scale, given.samp_scale, given.lat_scale, given.long_scale,
            given.height_scale,
        ]),
        np.array([
            given.line_num_coeff, given.line_den_coeff, given.samp_num_coeff, given.samp_den_coeff
        ]),
    )  # fmt: skip


def _of_text(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Numbers and coefficients of lines ``KEY: value unit``; KeyError or ValueError of others."""
    found = {}
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if value.strip():
            found[key.strip()] = float(value.split()[0])
    numbers = np.array([found[name] for name in NAMES])
    ratios = [[found[f"{name}_{k}"] for k in range(1, 21)] for name in RATIOS]
    return numbers, np.array(ratios)


def rpc_camera(
    rpc: GivenRPC, frame: LocalFrame, size: tuple[int, int], heights: tuple[float, float]
) -> np.ndarray:
    """The camera of an image of ``size`` (cols, rows) that sees as RPCs do.

    ``heights``: ellipsoidal, m, between which it does. Raises InputError if it misses them by more
    than MISFIT_PX.
    """
    cols, rows = size
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 11), np.linspace(-1, 1, 11)))
    image = np.column_stack([(1 + u) * (cols - 1) / 2, (1 + v) * (rows - 1) / 2])
    low, high = (_ground_of(rpc, frame, image, h) for h in heights)
    slope = (high - low)[:, :2] / (high - low)[:, 2:]
    ground = low[:, :2] - low[:, 2:] * slope
    cam = np.zeros(SIZE)
    cam[PER_COL] = cam[PER_LINE] = 1.0
    cam[COL0], cam[COLS] = (cols - 1) / 2, max(cols - 1, 1) / 2
    cam[ROW0], cam[ROWS] = (rows - 1) / 2, max(rows - 1, 1) / 2
    powers = np.column_stack(
        [np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3]
    )
    cubic = np.linalg.lstsq(powers, ground, rcond=None)[0]
    cam[GROUND_X : GROUND_X + 10], cam[GROUND_Y : GROUND_Y + 10] = cubic.T
    # where the rays of each line come nearest to each other
    by_line = [a - a.reshape(11, 11, 2).mean(axis=1).repeat(11, axis=0) for a in (ground, slope)]
    spread = float((by_line[1] ** 2).sum())
    station = -float((by_line[0] * by_line[1]).sum()) / spread if spread > 0 else STATIONS_M[1]
    if not STATIONS_M[0] < station < STATIONS_M[1]:
        station = STATIONS_M[1] if abs(station) > STATIONS_M[0] else STATIONS_M[0]
    cam[STATION_Z] = station
    above = ground + station * slope
    line = np.column_stack([np.ones_like(v), v, v * v])
    quadratic = np.linalg.lstsq(line, above, rcond=None)[0]
    cam[STATION_X : STATION_X + 3], cam[STATION_Y : STATION_Y + 3] = quadratic.T
    metres = np.array([
        [cubic[1, 0] / cam[COLS], cubic[2, 0] / cam[ROWS]],
        [cubic[1, 1] / cam[COLS], cubic[2, 1] / cam[ROWS]],
    ])  # fmt: skip
    cam[INVERSE : INVERSE + 4] = np.linalg.inv(metres).ravel()
    base, apex = powers @ cubic, line @ quadratic
    for points in (low, high):
        seen = base + (apex - base) / station * points[:, 2:]
        misfit = np.abs((seen - points[:, :2]) @ np.linalg.inv(metres).T).max()
        if not misfit < MISFIT_PX:
            raise InputError(
                "RPCs that no sensor follows which takes its image line by line: it would be off "
                f"by {misfit:.2g} px over {cols} x {rows} px",
                file=rpc.file,
                remedy="name the RPCs of another image, or a smaller place",
            )
    return cam


def _ground_of(rpc: GivenRPC, frame: LocalFrame, image: np.ndarray, height: float) -> np.ndarray:
    """World points [n, 3] that image points [n, 2] show at a height, by Newton's method."""
    lonlath = np.tile([rpc.numbers[3], rpc.numbers[2], height], (len(image), 1))
    for _ in range(30):
        miss = image - rpc.project(lonlath)
        steps = []
        for axis, step in ((0, 1e-6), (1, 1e-6)):
            moved = lonlath.copy()
            moved[:, axis] += step
            steps.append((rpc.project(moved) - rpc.project(lonlath)) / step)
        by_lon, by_lat = steps
        det = by_lon[:, 0] * by_lat[:, 1] - by_lon[:, 1] * by_lat[:, 0]
        lonlath[:, 0] += (miss[:, 0] * by_lat[:, 1] - miss[:, 1] * by_lat[:, 0]) / det
        lonlath[:, 1] += (by_lon[:, 0] * miss[:, 1] - by_lon[:, 1] * miss[:, 0]) / det
        if np.abs(miss).max() < 1e-9:
            break
    return frame.from_geodetic(lonlath)
