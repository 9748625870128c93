"""RPC00B coefficients: fitted to the rigorous camera, or given, as cameras of the twin of a place.

The fitted ones have an affine bias as real ones have. Given ones are read, moved over the twin's
place, cropped and turned round. RPCs tell where a ground point appears; rays need the way back. A
camera (:mod:`.camera`) is fitted to them; the camera, and not the RPCs, is the truth then.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.rpc import RPC as RPCMetadata

from stereotruth.core.errors import InputError

from .camera import (
    COLS,
    GROUND_X,
    GROUND_Y,
    INVERSE,
    MIDDLE_COL,
    MIDDLE_ROW,
    PER_COL,
    PER_LINE,
    ROWS,
    RPC_SIZE,
    STATION_X,
    STATION_Y,
    STATION_Z,
    LocalFrame,
    locate,
)

NUMBERS = ("line_off", "samp_off", "lat_off", "long_off", "height_off", "line_scale", "samp_scale",
           "lat_scale", "long_scale", "height_scale")  # fmt: skip
RATIOS = "line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff"

STATIONS_M = 2e5, 4e7  # heights of satellites
MISFIT_PX = 0.02


@dataclass(frozen=True)
class RPC:
    """RPC00B: ``numbers`` in the order of NUMBERS, ``coefficients`` float64[4, 20] of RATIOS."""

    numbers: np.ndarray
    coefficients: np.ndarray

    @property
    def metadata(self) -> RPCMetadata:
        """As images carry them."""
        values = dict(zip(NUMBERS, map(float, self.numbers)))
        values |= dict(zip(RATIOS, self.coefficients.tolist()))
        return RPCMetadata(**values, err_bias=12.0, err_rand=0.5)

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

    def over(self, lon: float, lat: float, height: float) -> RPC:
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

    def cropped(self, col: int, row: int) -> RPC:
        """The RPCs of the image from a column and a row on."""
        numbers = self.numbers.copy()
        numbers[:2] -= row, col
        return replace(self, numbers=numbers)


@dataclass(frozen=True)
class FittedRPC(RPC):
    """``bias`` float64[2, 3] maps true (col, row, 1) to what the RPCs predict.

    ``rms_px``: of the residuals, on points that did not make the fit.
    """

    bias: np.ndarray
    rms_px: float


@dataclass(frozen=True)
class GivenRPC(RPC):
    """RPCs of a ``file``."""

    file: Path


def terms(lon: np.ndarray, lat: np.ndarray, height: np.ndarray) -> np.ndarray:
    """The 20 cubic terms [n, 20] of normalised coordinates, in the order of RPC00B."""
    n = np.ones_like(lon)
    return np.stack(
        [n, lon, lat, height, lon * lat, lon * height, lat * height, lon**2, lat**2, height**2,
         lat * lon * height, lon**3, lon * lat**2, lon * height**2, lon**2 * lat, lat**3,
         lat * height**2, lon**2 * height, lat**2 * height, height**3],
        axis=-1,
    )  # fmt: skip


def draw_bias(cols: int, rows: int, seed: int, view: str) -> np.ndarray:
    """An affine bias [2, 3] of several px about the image centre, linear terms of 1e-4 to 3e-4."""
    rng = np.random.default_rng([seed, 4 if view == "left" else 5])
    linear = rng.choice([-1, 1], (2, 2)) * rng.uniform(1e-4, 3e-4, (2, 2))
    shift = rng.choice([-1, 1], 2) * rng.uniform(4, 11, 2)
    centre = np.array([(cols - 1) / 2, (rows - 1) / 2])
    return np.column_stack([np.eye(2) + linear, shift - linear @ centre])


def _fit_ratio(a: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator (first coefficient 1) of a ratio of cubics, least squares.

    Weak ridge: the denominator's cubic terms are nearly free over one scene. Reweighting by the
    last denominator makes the residuals those of the image.
    """
    weight = np.ones(len(a))
    ridge = np.full(39, 1e-6)
    for _ in range(4):
        design = np.hstack([a, -value[:, None] * a[:, 1:]]) / weight[:, None]
        normal = np.vstack([design, np.diag(ridge)])
        x = np.linalg.lstsq(normal, np.append(value / weight, np.zeros(39)), rcond=None)[0]
        weight = 1 + a[:, 1:] @ x[20:]
    return x[:20], np.append(1.0, x[20:])


def fit_rpc(
    cam: np.ndarray,
    frame: LocalFrame,
    *,
    cols: int,
    rows: int,
    heights: tuple[float, float],
    bias: np.ndarray,
) -> FittedRPC:
    """RPC00B of a camera over its image and a range of ellipsoidal heights (m)."""

    def cloud(n: int, levels: int, inset: float) -> tuple[np.ndarray, np.ndarray]:
        c, r, h = np.meshgrid(
            np.linspace(-20 + inset, cols + 20 - inset, n),
            np.linspace(-20 + inset, rows + 20 - inset, n),
            np.linspace(heights[0] + inset, heights[1] - inset, levels),
        )
        true = np.column_stack([c.ravel(), r.ravel()])
        ground = frame.to_geodetic(locate(cam, frame, true, h.ravel()))
        off = ground[:, 0] - frame.lon
        ground[:, 0] -= 360.0 * np.sign(off) * (np.abs(off) > 180.0)  # across the line of 180
        return ground, true

    ground, true = cloud(11, 6, 0.0)
    middle = (ground.max(axis=0) + ground.min(axis=0)) / 2
    half = (ground.max(axis=0) - ground.min(axis=0)) / 2
    # offsets and scales as they are written, so that rounding enters the fit
    lon_off, lat_off = np.round(middle[:2], 8)
    lon_scale, lat_scale = np.round(half[:2], 8)
    h_off, h_scale = np.round(middle[2], 2), np.round(half[2], 2)
    offset = np.round([(cols - 1) / 2, (rows - 1) / 2], 1)
    scale = np.round([cols / 2 + 20, rows / 2 + 20], 1)

    def design(points: np.ndarray) -> np.ndarray:
        return terms(
            (points[:, 0] - lon_off) / lon_scale,
            (points[:, 1] - lat_off) / lat_scale,
            (points[:, 2] - h_off) / h_scale,
        )

    a = design(ground)
    biased = true @ bias[:, :2].T + bias[:, 2]
    samp = _fit_ratio(a, (biased[:, 0] - offset[0]) / scale[0])
    line = _fit_ratio(a, (biased[:, 1] - offset[1]) / scale[1])
    ground, true = cloud(10, 5, 7.0)
    a = design(ground)
    found = np.column_stack([(a @ num) / (a @ den) for num, den in (samp, line)]) * scale + offset
    miss = found - (true @ bias[:, :2].T + bias[:, 2])
    numbers = np.array([offset[1], offset[0], lat_off, lon_off, h_off,
                        scale[1], scale[0], lat_scale, lon_scale, h_scale])  # fmt: skip
    rms_px = float(np.sqrt((miss**2).sum(axis=1).mean()))
    return FittedRPC(numbers, np.stack([*line, *samp]), bias, rms_px)


def read_rpc(file: str | Path) -> GivenRPC:
    """RPCs of an image, by GDAL, or of a text in the form of ``_RPC.TXT``.

    Raises InputError if the file has none.
    """
    file = Path(file)
    if not file.is_file():
        raise InputError("there is no such file", file=file, remedy="name images with RPCs")
    try:
        return GivenRPC(*_of_text(file.read_text(encoding="ascii")), file)
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
    numbers, ratios = (
        np.array([getattr(given, name) for name in names]) for names in (NUMBERS, RATIOS)
    )
    return GivenRPC(numbers, ratios, file)


def _of_text(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Numbers and coefficients of lines ``KEY: value unit``; KeyError or ValueError of others."""
    found = {}
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if value.strip():
            found[key.strip().lower()] = float(value.split()[0])
    numbers = np.array([found[name] for name in NUMBERS])
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
    cam = np.zeros(RPC_SIZE)
    cam[PER_COL] = cam[PER_LINE] = 1.0
    cam[MIDDLE_COL], cam[COLS] = (cols - 1) / 2, max(cols - 1, 1) / 2
    cam[MIDDLE_ROW], cam[ROWS] = (rows - 1) / 2, max(rows - 1, 1) / 2
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
