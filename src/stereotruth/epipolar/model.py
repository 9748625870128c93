"""The epipolar model of a scene: from image to epipolar grid and back, and its JSON file.

The model is two smooth maps (FORMULA), bicubic splines on top of an affine part, fitted by
:mod:`.fit`. The compiled kernels of this module evaluate and invert them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Floats
from ..core.numerics.interpolation import cubic_slopes, cubic_weights
from ..core.products.files import atomic_file, read_record, sealed
from ..sensor.rpc import LineCorrection, SensorModel, of_record, project_block, read_correction

Four = tuple[float, float, float, float]

COLOURS = ("red", "green", "blue")  # layers of rectified images in colour, beside `image`
FORMULA = (
    "For each image: x = x_affine . (col, row, 1) + S(x_spline; col, row) and "
    "y = y_affine . (col, row, 1) + S(y_spline; col, row); all in px. (col, row) is the pixel "
    "coordinate in the original image, (0, 0) the centre of its upper-left pixel; (x, y) that in "
    "the rectified images (both on the same grid of `shape` = [rows, cols]). S is a uniform "
    "bicubic B-spline with n x n coefficients c[j][i] (j along rows, i along columns; an absent "
    "spline is zero) on the domain [col_min, col_max] x [row_min, row_max]: "
    "s = (col - col_min) / (col_max - col_min) * (n - 3), i0 = min(floor(s), n - 4), f = s - i0; "
    "t, j0, g likewise from the row; S = sum over a, b in 0..3 of w_b(g) w_a(f) c[j0 + b][i0 + a]; "
    "w_0(f) = (1 - f)^3 / 6, w_1(f) = (3 f^3 - 6 f^2 + 4) / 6, "
    "w_2(f) = (-3 f^3 + 3 f^2 + 3 f + 1) / 6, w_3(f) = f^3 / 6. Outside the domain S is continued "
    "linearly from the nearest point of the domain. The inverse is by Newton's method. "
    "disparity = x_left - x_right, and increases with height."
)
BY_LINE = (
    " (col, row) is that of the smooth sensor: the image shows it at (col, row) + (C(row), R(row)) "
    "of by_line."
)

# ------------------------------------------------------------------ kernels

# One image's packed model: [0:6] x and y affine, [6] col_min, [7] cells per px along columns,
# [8] row_min, [9] cells per px along rows, [10] n, [11] start of the x coefficients (0: none),
# [12:12 + n²] coefficients of y, then those of x. The same splines follow as polynomials, 16
# coefficients for each of their (n - 3)² cells: those of y from m[12 + n²] or, if there is an x,
# m[12 + 2 n²] on, then those of x; [4 b + a] belongs to f**a g**b.
_BLOCK = 256  # points worked on together
POWERS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6  # of weights


@inner
def _row_sum(m: Floats, k: int, w: Four) -> float:
    return m[k] * w[0] + m[k + 1] * w[1] + m[k + 2] * w[2] + m[k + 3] * w[3]


@inner
def _patch(m: Floats, k: int, n: int, w: Four, v: Four) -> float:
    """Sum over the 4 × 4 coefficients from m[k]: weights w along columns, v along rows."""
    return (
        v[0] * _row_sum(m, k, w)
        + v[1] * _row_sum(m, k + n, w)
        + v[2] * _row_sum(m, k + 2 * n, w)
        + v[3] * _row_sum(m, k + 3 * n, w)
    )


@kernel
def forward_with_slopes(
    m: Floats, col: float, row: float
) -> tuple[float, float, float, float, float, float]:
    """Epipolar (x, y) of an image point and dx/dcol, dx/drow, dy/dcol, dy/drow."""
    n = int(m[10])
    top = n - 3.0
    s = (col - m[6]) * m[7]
    t = (row - m[8]) * m[9]
    if not (np.isfinite(s) and np.isfinite(t)):
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    inside_s = min(max(s, 0.0), top)
    inside_t = min(max(t, 0.0), top)
    i = min(int(inside_s), n - 4)
    j = min(int(inside_t), n - 4)
    w, dw = cubic_weights(inside_s - i), cubic_slopes(inside_s - i)
    v, dv = cubic_weights(inside_t - j), cubic_slopes(inside_t - j)
    beyond_s, beyond_t = s - inside_s, t - inside_t
    k = 12 + j * n + i
    ys = _patch(m, k, n, dw, v)
    yt = _patch(m, k, n, w, dv)
    y = _patch(m, k, n, w, v) + beyond_s * ys + beyond_t * yt
    x, xs, xt = 0.0, 0.0, 0.0
    if m[11] > 0.0:
        k += int(m[11]) - 12
        xs = _patch(m, k, n, dw, v)
        xt = _patch(m, k, n, w, dv)
        x = _patch(m, k, n, w, v) + beyond_s * xs + beyond_t * xt
    return (
        m[0] * col + m[1] * row + m[2] + x,
        m[3] * col + m[4] * row + m[5] + y,
        m[0] + xs * m[7],
        m[1] + xt * m[9],
        m[3] + ys * m[7],
        m[4] + yt * m[9],
    )


@inlined
def _cell(m: Floats, s: float, t: float) -> int:
    """Number of the spline's cell in which a place lies; -1 outside of the domain."""
    last = int(m[10]) - 4
    inside = (s >= 0.0) & (s <= last + 1.0) & (t >= 0.0) & (t <= last + 1.0)
    i, j = min(int(s if inside else 0.0), last), min(int(t if inside else 0.0), last)
    return j * (last + 1) + i if inside else -1


@inlined
def _bicubic(f: float, g: float, p0: Four, p1: Four, p2: Four, p3: Four) -> float:
    """Polynomial of a cell: one tuple for each power of g, in it one for each power of f."""
    a = p0[0] + f * (p0[1] + f * (p0[2] + f * p0[3]))
    b = p1[0] + f * (p1[1] + f * (p1[2] + f * p1[3]))
    c = p2[0] + f * (p2[1] + f * (p2[2] + f * p2[3]))
    d = p3[0] + f * (p3[1] + f * (p3[2] + f * p3[3]))
    return a + g * (b + g * (c + g * d))


@inlined
def _powers(m: Floats, k: int) -> Four:
    return m[k], m[k + 1], m[k + 2], m[k + 3]


@inner
def forward_point(m: Floats, col: float, row: float) -> tuple[float, float]:
    """Epipolar (x, y) in px of one image point; ``m`` is a packed image model."""
    s = (col - m[6]) * m[7]
    t = (row - m[8]) * m[9]
    cell = _cell(m, s, t)
    if cell < 0:
        x, y, _, _, _, _ = forward_with_slopes(m, col, row)
        return x, y
    n = int(m[10])
    f, g = s - cell % (n - 3), t - cell // (n - 3)
    x = m[0] * col + m[1] * row + m[2]
    y = m[3] * col + m[4] * row + m[5]
    k = 12 + n * n * (2 if m[11] > 0.0 else 1) + 16 * cell
    y += _bicubic(f, g, _powers(m, k), _powers(m, k + 4), _powers(m, k + 8), _powers(m, k + 12))
    if m[11] > 0.0:
        k += 16 * (n - 3) ** 2
        x += _bicubic(f, g, _powers(m, k), _powers(m, k + 4), _powers(m, k + 8), _powers(m, k + 12))
    return x, y


@inner
def _cell_of_all(m: Floats, col: Floats, row: Floats, f: Floats, g: Floats) -> int:
    """Number of the spline's cell in which a block of points lies, with their places f, g in it.

    -1 if the points do not share a cell, or lie outside of the domain; then f, g are not filled.
    """
    col_min, per_col, row_min, per_row = m[6], m[7], m[8], m[9]
    low, high = 1 << 30, -1
    for k in range(col.size):
        f[k] = (col[k] - col_min) * per_col
        g[k] = (row[k] - row_min) * per_row
        cell = _cell(m, f[k], g[k])
        low, high = min(low, cell), max(high, cell)
    if low != high:
        return -1
    side = int(m[10]) - 3
    i, j = low % side, low // side
    for k in range(col.size):
        f[k] -= i
        g[k] -= j
    return low


@inner
def _affine(m: Floats, k: int, col: Floats, row: Floats, out: Floats) -> None:
    a, b, c = m[k], m[k + 1], m[k + 2]
    for i in range(col.size):
        out[i] = a * col[i] + b * row[i] + c


@inner
def _add_bicubic(m: Floats, k: int, f: Floats, g: Floats, out: Floats) -> None:
    p0, p1, p2, p3 = _powers(m, k), _powers(m, k + 4), _powers(m, k + 8), _powers(m, k + 12)
    for i in range(f.size):
        out[i] += _bicubic(f[i], g[i], p0, p1, p2, p3)


@inner
def _forward_block(
    m: Floats, col: Floats, row: Floats, f: Floats, g: Floats, x: Floats, y: Floats
) -> None:
    """Fill ``x`` and ``y`` with what forward_point gives, to the bit; ``f``, ``g`` are scratch.

    The cells of the spline are thousands of pixels wide: the points of a block nearly always share
    one, and then its coefficients are loaded once.
    """
    cell = _cell_of_all(m, col, row, f, g)
    if cell < 0:
        for k in range(col.size):
            x[k], y[k] = forward_point(m, col[k], row[k])
        return
    n = int(m[10])
    _affine(m, 0, col, row, x)
    _affine(m, 3, col, row, y)
    k = 12 + n * n * (2 if m[11] > 0.0 else 1) + 16 * cell
    _add_bicubic(m, k, f, g, y)
    if m[11] > 0.0:
        _add_bicubic(m, k + 16 * (n - 3) ** 2, f, g, x)


@inner
def inverse_point(m: Floats, x: float, y: float) -> tuple[float, float]:
    """Image (col, row) in px of one epipolar point, by Newton; (NaN, NaN) if it diverges."""
    det = m[0] * m[4] - m[1] * m[3]
    col = ((x - m[2]) * m[4] - (y - m[5]) * m[1]) / det
    row = ((y - m[5]) * m[0] - (x - m[2]) * m[3]) / det
    for _ in range(30):
        fx, fy, xc, xr, yc, yr = forward_with_slopes(m, col, row)
        det = xc * yr - xr * yc
        dcol = ((x - fx) * yr - (y - fy) * xr) / det
        drow = ((y - fy) * xc - (x - fx) * yc) / det
        col += dcol
        row += drow
        step = max(abs(dcol), abs(drow))
        if step < 1e-6:  # quadratic convergence: what is left is below 1e-9 px
            return col, row
        if not np.isfinite(step):
            break
    return np.nan, np.nan


@kernel
def map_points(m: Floats, inverse: bool, a: Floats, b: Floats, out: Floats) -> None:
    """Fill ``out`` [2, n] with the forward or the inverse map of n points."""
    for i in range(a.size):
        u, v = inverse_point(m, a[i], b[i]) if inverse else forward_point(m, a[i], b[i])
        out[0, i] = u
        out[1, i] = v


@kernel
def ground_points_to_epipolar(
    sensors: Floats, left: Floats, right: Floats, lon: Floats, lat: Floats, height: Floats,
    out: Floats,
) -> None:  # fmt: skip
    """Fill ``out`` [4, n] with x_left, y_left, x_right, y_right of n ground points.

    ``sensors`` [2, 96] are the packed sensor models, ``left`` and ``right`` the packed epipolar
    ones. Goes in blocks, so that all loops are vectorised and stay in the cache.
    """
    # Arrays of their own: LLVM vectorises no loop that writes to two rows of one.
    columns, rows = np.empty(_BLOCK), np.empty(_BLOCK)
    s, t = np.empty(_BLOCK), np.empty(_BLOCK)
    for start in range(0, lon.size, _BLOCK):
        end = min(start + _BLOCK, lon.size)
        col, row = columns[: end - start], rows[: end - start]
        f, g = s[: end - start], t[: end - start]
        for k in range(2):
            project_block(sensors[k], lon[start:end], lat[start:end], height[start:end], col, row)
            m = left if k == 0 else right
            _forward_block(m, col, row, f, g, out[2 * k, start:end], out[2 * k + 1, start:end])


# ------------------------------------------------------------------ models


def _cells(spline: Floats) -> Floats:
    """[n - 3, n - 3, 4, 4]: the polynomials of a spline's cells, by powers of g and f."""
    windows = np.lib.stride_tricks.sliding_window_view(spline, (4, 4))
    return np.einsum("bq,jiqp,ap->jiba", POWERS, windows, POWERS)


@dataclass(frozen=True, eq=False)
class ImageModel:
    """Map between one image's (col, row) and epipolar (x, y); see FORMULA for the meaning.

    ``affine`` float64[2, 3] rows x, y; ``domain`` (col_min, row_min, col_max, row_max) px;
    ``y_spline`` and ``x_spline`` float64[n, n] px ([row, col]; ``x_spline`` may be None). Of an
    image with a correction ``by_line``, all of this is of the smooth sensor's (col, row), as
    ``packed`` for the kernels is; :meth:`forward` and :meth:`inverse` know the image's own.
    """

    affine: Floats
    domain: tuple[float, float, float, float]
    y_spline: Floats
    x_spline: Floats | None = None
    by_line: LineCorrection | None = None
    packed: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.y_spline)
        col_min, row_min, col_max, row_max = self.domain
        x = np.empty(0) if self.x_spline is None else np.asarray(self.x_spline, dtype=np.float64)
        header = [
            *np.asarray(self.affine, dtype=np.float64).reshape(-1),
            col_min,
            (n - 3) / (col_max - col_min),
            row_min,
            (n - 3) / (row_max - row_min),
            n,
            12 + n * n if x.size else 0,
        ]
        splines = [np.asarray(self.y_spline, dtype=np.float64), *([x] if x.size else [])]
        packed = np.concatenate(
            [header, *(c.reshape(-1) for c in splines), *(_cells(c).reshape(-1) for c in splines)]
        )
        object.__setattr__(self, "packed", packed)

    @property
    def smooth(self) -> ImageModel:
        """The model of the smooth sensor's (col, row)."""
        return self if self.by_line is None else replace(self, by_line=None)

    def forward(self, col: ArrayLike, row: ArrayLike) -> tuple[Floats, Floats]:
        """Epipolar (x, y) of image points, px; arrays broadcast."""
        if self.by_line is not None:
            col, row = self.by_line.take(col, row)
        return self._map(False, col, row)

    def inverse(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Image (col, row) of epipolar points, px; arrays broadcast; NaN if there is none."""
        at = self._map(True, x, y)
        return at if self.by_line is None else self.by_line.add(*at)

    def _map(self, inverse: bool, a: ArrayLike, b: ArrayLike) -> tuple[Floats, Floats]:
        pair = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
        flat = [np.ascontiguousarray(c).reshape(-1) for c in pair]
        out = np.empty((2, flat[0].size))
        map_points(self.packed, inverse, flat[0], flat[1], out)
        return out[0].reshape(pair[0].shape), out[1].reshape(pair[0].shape)

    def slopes(self, col: ArrayLike, row: ArrayLike) -> Floats:
        """[..., 2, 2]: change of (x, y) with (col, row) at image points; arrays broadcast."""
        steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
        ends = [self.forward(np.add(col, a), np.add(row, b)) for a, b in steps]
        e = np.stack([np.stack(end, axis=-1) for end in ends])
        return np.stack([e[0] - e[1], e[2] - e[3]], axis=-1) / 2.0

    def shifted(self, x: float, y: float) -> ImageModel:
        """The same model with its origin of (x, y) moved there."""
        affine = np.array(self.affine)
        affine[:, 2] -= (x, y)
        return replace(self, affine=affine)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, in the words of FORMULA."""
        names = ("col_min", "row_min", "col_max", "row_max")
        return {
            "x_affine": self.affine[0].tolist(),
            "y_affine": self.affine[1].tolist(),
            "spline_domain": dict(zip(names, self.domain)),
            "n": len(self.y_spline),
            "y_spline": self.y_spline.tolist(),
            "x_spline": None if self.x_spline is None else self.x_spline.tolist(),
        } | of_record(self.by_line)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ImageModel:
        """The inverse of :meth:`to_dict`."""
        domain = values["spline_domain"]
        x = values["x_spline"]
        return cls(
            np.array([values["x_affine"], values["y_affine"]], dtype=np.float64),
            (domain["col_min"], domain["row_min"], domain["col_max"], domain["row_max"]),
            np.array(values["y_spline"], dtype=np.float64),
            None if x is None else np.array(x, dtype=np.float64),
            read_correction(values),
        )


@dataclass(frozen=True, eq=False)
class EpipolarModel:
    """The epipolar geometry of a pair: sensors, image models and the common grid.

    ``shape`` (rows, cols) of both rectified images; ``left_size``, ``right_size`` (cols, rows) of
    the originals; ``height_range`` ellipsoidal m; ``ground_box`` (lon_min, lat_min, lon_max,
    lat_max) degrees, what the virtual points covered; ``report``: how good the model is;
    """

    left: SensorModel
    right: SensorModel
    left_image: ImageModel
    right_image: ImageModel
    shape: tuple[int, int]
    left_size: tuple[int, int]
    right_size: tuple[int, int]
    reference_height: float
    height_range: tuple[float, float]
    ground_box: tuple[float, float, float, float]
    report: dict[str, Any]

    @cached_property
    def sensors(self) -> Floats:
        """[2, 96]: left and right sensor, packed for kernels."""
        return np.stack([self.left.packed(), self.right.packed()])

    @property
    def has_lines(self) -> bool:
        """Whether an image has a correction by line."""
        return self.left_image.by_line is not None or self.right_image.by_line is not None

    def left_to_epipolar(self, col: ArrayLike, row: ArrayLike) -> tuple[Floats, Floats]:
        """Epipolar (x, y) of points of the left image, px."""
        return self.left_image.forward(col, row)

    def right_to_epipolar(self, col: ArrayLike, row: ArrayLike) -> tuple[Floats, Floats]:
        """Epipolar (x, y) of points of the right image, px."""
        return self.right_image.forward(col, row)

    def epipolar_to_left(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """(col, row) in the left image of epipolar points, px; NaN if there is none."""
        return self.left_image.inverse(x, y)

    def epipolar_to_right(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """(col, row) in the right image of epipolar points, px; NaN if there is none."""
        return self.right_image.inverse(x, y)

    def ground_to_epipolar(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> Floats:
        """float64[4, n]: x_left, y_left, x_right, y_right in px of n ground points.

        Degrees and ellipsoidal m. One fused kernel that frees the GIL.
        """
        lon, lat, height = (
            np.ascontiguousarray(c).reshape(-1)
            for c in np.broadcast_arrays(
                *(np.asarray(c, dtype=np.float64) for c in (lon, lat, height))
            )
        )
        out = np.empty((4, lon.size))
        ground_points_to_epipolar(
            self.sensors, self.left_image.packed, self.right_image.packed, lon, lat, height, out
        )
        return out

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where the left image's ray meets an ellipsoidal height in m."""
        return self.left.localize(*self.epipolar_to_left(x, y), height)

    def disparities(self) -> tuple[int, int]:
        """Least and greatest disparity of the model's heights over its grid, whole px."""
        rows, cols = self.shape
        axes = np.linspace(0.0, cols - 1.0, 5), np.linspace(0.0, rows - 1.0, 5), self.height_range
        x, y, height = (grid.reshape(-1) for grid in np.meshgrid(*axes))
        there = self.ground_to_epipolar(*self.epipolar_to_ground(x, y, height), height)[2]
        return int(np.floor(np.nanmin(x - there))), int(np.ceil(np.nanmax(x - there)))

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, with the formula: enough to evaluate the model without this software."""
        return {
            "what": "epipolar geometry of a stereo pair: original image <-> rectified image",
            "formula": FORMULA + BY_LINE * self.has_lines,
            "units": "coordinates px, longitude and latitude degrees (WGS 84), heights m "
            "(ellipsoidal)",
            "shape": list(self.shape),
            "left_to_epipolar": self.left_image.to_dict(),
            "right_to_epipolar": self.right_image.to_dict(),
            "left_sensor": self.left.to_dict(),
            "right_sensor": self.right.to_dict(),
            "left_size": list(self.left_size),
            "right_size": list(self.right_size),
            "reference_height": self.reference_height,
            "height_range": list(self.height_range),
            "ground_box": list(self.ground_box),
            "report": self.report,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> EpipolarModel:
        """The inverse of :meth:`to_dict`."""
        return cls(
            left=SensorModel.from_dict(values["left_sensor"]),
            right=SensorModel.from_dict(values["right_sensor"]),
            left_image=ImageModel.from_dict(values["left_to_epipolar"]),
            right_image=ImageModel.from_dict(values["right_to_epipolar"]),
            shape=tuple(values["shape"]),
            left_size=tuple(values["left_size"]),
            right_size=tuple(values["right_size"]),
            reference_height=values["reference_height"],
            height_range=tuple(values["height_range"]),
            ground_box=tuple(values["ground_box"]),
            report=dict(values["report"]),
        )

    def save(self, path: str | Path, provenance: Mapping[str, Any] | None = None) -> None:
        """Write the model and its provenance as JSON; the file appears when it is whole."""
        record = self.to_dict() | {"provenance": dict(provenance or {})}
        with atomic_file(path) as scratch:
            scratch.write_text(sealed(record), encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> EpipolarModel:
        """Read what :meth:`save` wrote. Raises InputError if it cannot be used."""
        return read_record(path, cls.from_dict, what="epipolar model", stage="rectify")
