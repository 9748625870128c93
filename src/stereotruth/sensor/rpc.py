"""Rational polynomial camera models (RPC00B), and their corrections by an affine and by line.

Image coordinates are (col, row) = (sample, line) with (0, 0) at the centre of the upper-left pixel,
ground coordinates are WGS 84 longitude, latitude in degrees and ellipsoidal height in metres.
RPC00B and the order of its 20 terms: NGA STDI-0002, Appendix E.

The correction by line moves a whole line along its columns and across them, for an attitude that
jitters. The kernels know the smooth sensor alone; the correction is added where a position in the
image itself is asked for, so that all polynomials of the smooth sensor stay exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import continuous
from ..core.numerics.interpolation import cubic_weights

# The packed form: ten offsets and scales, coefficients, the affine.
SAMP_NUM, SAMP_DEN, LINE_NUM, LINE_DEN, AFFINE = 10, 30, 50, 70, 90
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
# The largest size that a sensor's offsets (px, degrees, m) and coefficients can have, with a wide
# margin: an image of 10 million px, of the whole Earth. Old cropping tools leave scales alone, so
# that normalised image coordinates, and with them numerators, may reach some hundreds.
LIMITS = {
    "line_off": 1e7,
    "samp_off": 1e7,
    "lat_off": 90.0,
    "long_off": 360.0,
    "height_off": 12e3,
    "line_scale": 1e7,
    "samp_scale": 1e7,
    "lat_scale": 90.0,
    "long_scale": 360.0,
    "height_scale": 30e3,
}
LARGEST_COEFFICIENT, SMALLEST_SCALE = 1e6, 1e-9
SCALARS = tuple(LIMITS)
VECTORS = ("line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff")
ROUNDS = 12  # of the inverse by line: each leaves a hundredth where a line is off by 0.01 px a line
MEANING = (
    "(col, row)_image = (col, row) + (C(row), R(row)), px, (col, row) being that of RPC and "
    "affine. C and R are uniform cubic B-splines with n coefficients c[i] on [row_min, row_max]: "
    "s = (row - row_min) / (row_max - row_min) * (n - 3), i0 = min(floor(s), n - 4), f = s - i0, "
    "sum over a in 0..3 of w_a(f) c[i0 + a], w_0(f) = (1 - f)^3 / 6, w_1(f) = (3 f^3 - 6 f^2 + 4) "
    "/ 6, w_2(f) = (-3 f^3 + 3 f^2 + 3 f + 1) / 6, w_3(f) = f^3 / 6; beyond, the value of the "
    "nearest end"
)


# error_model="numpy" (no exception on division by zero) lets LLVM vectorise the loops, if what they
# call is inlined: 6 instead of 22 ns a point.
@inlined
def _cubic(c: Floats, i: int, x: float, y: float, z: float) -> float:
    """The 20-term polynomial of RPC00B with coefficients c[i:i+20] at L=x, P=y, H=z (nested)."""
    return (
        c[i]
        + x
        * (
            c[i + 1]
            + x * (c[i + 7] + x * c[i + 11] + y * c[i + 14] + z * c[i + 17])
            + y * (c[i + 4] + y * c[i + 12] + z * c[i + 10])
            + z * (c[i + 5] + z * c[i + 13])
        )
        + y
        * (
            c[i + 2]
            + y * (c[i + 8] + y * c[i + 15] + z * c[i + 18])
            + z * (c[i + 6] + z * c[i + 16])
        )
        + z * (c[i + 3] + z * (c[i + 9] + z * c[i + 19]))
    )


@inner
def _cubic_dx(c: Floats, i: int, x: float, y: float, z: float) -> float:
    """Derivative of :func:`_cubic` by x (normalised longitude)."""
    return (
        c[i + 1]
        + x * (2.0 * (c[i + 7] + y * c[i + 14] + z * c[i + 17]) + 3.0 * x * c[i + 11])
        + y * (c[i + 4] + y * c[i + 12] + z * c[i + 10])
        + z * (c[i + 5] + z * c[i + 13])
    )


@inner
def _cubic_dy(c: Floats, i: int, x: float, y: float, z: float) -> float:
    """Derivative of :func:`_cubic` by y (normalised latitude)."""
    return (
        c[i + 2]
        + y * (2.0 * (c[i + 8] + x * c[i + 12] + z * c[i + 18]) + 3.0 * y * c[i + 15])
        + x * (c[i + 4] + x * c[i + 14] + z * c[i + 10])
        + z * (c[i + 6] + z * c[i + 16])
    )


@inlined
def project_point(packed: Floats, lon: float, lat: float, height: float) -> tuple[float, float]:
    """Image (col, row) in px of one ground point; ``packed`` is ``SensorModel.packed()``.

    Any longitude that differs by a turn gives the same result. Called inside a plain loop it is
    vectorised by LLVM (see ``project_points``), with the same bits as one call at a time.
    """
    dlon = lon - packed[3]
    dlon = dlon - 360.0 if dlon > 180.0 else dlon
    dlon = dlon + 360.0 if dlon < -180.0 else dlon
    x = dlon / packed[8]
    y = (lat - packed[2]) / packed[7]
    z = (height - packed[4]) / packed[9]
    samp = _cubic(packed, SAMP_NUM, x, y, z) / _cubic(packed, SAMP_DEN, x, y, z)
    line = _cubic(packed, LINE_NUM, x, y, z) / _cubic(packed, LINE_DEN, x, y, z)
    samp = samp * packed[6] + packed[1]
    line = line * packed[5] + packed[0]
    col = packed[AFFINE] * samp + packed[AFFINE + 1] * line + packed[AFFINE + 2]
    row = packed[AFFINE + 3] * samp + packed[AFFINE + 4] * line + packed[AFFINE + 5]
    return col, row


@inner
def project_block(
    packed: Floats, lon: Floats, lat: Floats, height: Floats, col: Floats, row: Floats
) -> None:
    """Fill ``col`` and ``row``, arrays of their own, with the image points of n ground points."""
    for i in range(lon.size):
        col[i], row[i] = project_point(packed, lon[i], lat[i], height[i])


@kernel
def project_points(packed: Floats, lon: Floats, lat: Floats, height: Floats, out: Floats) -> None:
    """Fill ``out`` [2, n] with (col, row) of n ground points (degrees, degrees, m)."""
    # A function of its own: LLVM must not see that both results go to one array.
    project_block(packed, lon, lat, height, out[0], out[1])


@inner
def localize_point(packed: Floats, col: float, row: float, height: float) -> tuple[float, float]:
    """Ground (lon, lat) in degrees where the ray of a pixel meets an ellipsoidal height in m.

    Newton with the analytic Jacobian from the RPC's ground offset; (NaN, NaN) if it does not
    converge. The RPC's image scales play no part, so any normalised image coordinate will do.
    """
    a, b, c = packed[AFFINE], packed[AFFINE + 1], packed[AFFINE + 2]
    d, e, f = packed[AFFINE + 3], packed[AFFINE + 4], packed[AFFINE + 5]
    turn = a * e - b * d
    samp = (((col - c) * e - (row - f) * b) / turn - packed[1]) / packed[6]
    line = (((row - f) * a - (col - c) * d) / turn - packed[0]) / packed[5]
    z = (height - packed[4]) / packed[9]
    x, y = 0.0, 0.0
    for _ in range(50):
        sd = _cubic(packed, SAMP_DEN, x, y, z)
        ld = _cubic(packed, LINE_DEN, x, y, z)
        s = _cubic(packed, SAMP_NUM, x, y, z) / sd
        t = _cubic(packed, LINE_NUM, x, y, z) / ld
        sx = (_cubic_dx(packed, SAMP_NUM, x, y, z) - s * _cubic_dx(packed, SAMP_DEN, x, y, z)) / sd
        sy = (_cubic_dy(packed, SAMP_NUM, x, y, z) - s * _cubic_dy(packed, SAMP_DEN, x, y, z)) / sd
        tx = (_cubic_dx(packed, LINE_NUM, x, y, z) - t * _cubic_dx(packed, LINE_DEN, x, y, z)) / ld
        ty = (_cubic_dy(packed, LINE_NUM, x, y, z) - t * _cubic_dy(packed, LINE_DEN, x, y, z)) / ld
        determinant = sx * ty - sy * tx
        dx = ((samp - s) * ty - (line - t) * sy) / determinant
        dy = ((line - t) * sx - (samp - s) * tx) / determinant
        step = max(abs(dx), abs(dy))
        if step > 2.0:  # twice the RPC's ground box: keep the search from being thrown out of it
            dx *= 2.0 / step
            dy *= 2.0 / step
        x += dx
        y += dy
        # Steps stall at some 1e-15 of the box; 1e-12 of it is below a micrometre on the ground,
        # and convergence is quadratic, so that the last step taken leaves less.
        if step < 1e-12:
            return x * packed[8] + packed[3], y * packed[7] + packed[2]
        if not np.isfinite(step):
            break
    return np.nan, np.nan


@kernel
def localize_points(packed: Floats, col: Floats, row: Floats, height: Floats, out: Floats) -> None:
    """Fill ``out`` [2, n] with (lon, lat) of n image points (px, px, m)."""
    for i in range(col.size):
        lon, lat = localize_point(packed, col[i], row[i], height[i])
        out[0, i] = lon
        out[1, i] = lat


def _batch(kernel: Any, packed: Floats, *coordinates: ArrayLike) -> tuple[Floats, Floats]:
    """Apply a [2, n] kernel to broadcast coordinates; results have the broadcast shape."""
    arrays = np.broadcast_arrays(*(np.asarray(c, dtype=np.float64) for c in coordinates))
    flat = [np.ascontiguousarray(a).reshape(-1) for a in arrays]
    out = np.empty((2, flat[0].size))
    kernel(packed, *flat, out)
    return out[0].reshape(arrays[0].shape), out[1].reshape(arrays[0].shape)


@dataclass(frozen=True, eq=False)
class RPC:
    """RPC00B: offsets and scales in px, degrees and m; coefficients float64[20] in RPC00B order.

    Raises ValueError, naming the field, if one is not finite or beyond :data:`LIMITS`, a scale is
    zero or a denominator vanishes.
    """

    line_off: float
    samp_off: float
    lat_off: float
    long_off: float
    height_off: float
    line_scale: float
    samp_scale: float
    lat_scale: float
    long_scale: float
    height_scale: float
    line_num_coeff: Floats
    line_den_coeff: Floats
    samp_num_coeff: Floats
    samp_den_coeff: Floats

    def __post_init__(self) -> None:
        for name in SCALARS:
            value = float(getattr(self, name))
            if name == "long_off" and abs(value) <= LIMITS[name]:
                value = float(continuous(value))
            if not np.isfinite(value):
                raise ValueError(f"{name} is not finite")
            if name.endswith("_scale") and abs(value) < SMALLEST_SCALE:
                raise ValueError(f"{name} is zero")
            if abs(value) > LIMITS[name]:
                raise ValueError(f"{name} is {value:g}, no sensor's is beyond {LIMITS[name]:g}")
            object.__setattr__(self, name, value)
        for name in VECTORS:
            values = np.array(getattr(self, name), dtype=np.float64).reshape(-1)
            if values.size != 20:
                raise ValueError(f"{name} has {values.size} coefficients instead of 20")
            if not np.isfinite(values).all():
                raise ValueError(f"{name} holds a coefficient that is not finite")
            if np.abs(values).max() > LARGEST_COEFFICIENT:
                raise ValueError(f"{name} holds {values[np.abs(values).argmax()]:g}")
            if "_den_" in name and not values.any():
                raise ValueError(f"{name} is zero throughout")
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    def project(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> tuple[Floats, Floats]:
        """Image (col, row) in px of ground points; arrays broadcast."""
        return SensorModel(self).project(lon, lat, height)

    def localize(self, col: ArrayLike, row: ArrayLike, height: ArrayLike) -> tuple[Floats, Floats]:
        """Ground (lon, lat) in degrees of image points at ellipsoidal heights in m.

        Arrays broadcast. NaN where the search does not converge.
        """
        return SensorModel(self).localize(col, row, height)

    @property
    def ground_box(self) -> tuple[float, float, float, float, float, float]:
        """(lon_min, lat_min, lon_max, lat_max, height_min, height_max): where the RPC was fitted.

        That is offset ± scale; degrees and m. Longitudes may pass 180.
        """
        centre = np.array([self.long_off, self.lat_off, self.height_off])
        half = np.abs([self.long_scale, self.lat_scale, self.height_scale])
        low, high = centre - half, centre + half
        return tuple(float(v) for v in (low[0], low[1], high[0], high[1], low[2], high[2]))

    def denominators(self, lon: Floats, lat: Floats, height: Floats) -> Floats:
        """float64[2, n]: sample and line denominator at n ground points; zero is a pole."""
        terms = self.terms(lon, lat, height)
        return np.stack([terms @ self.samp_den_coeff, terms @ self.line_den_coeff])

    def terms(self, lon: Floats, lat: Floats, height: Floats) -> Floats:
        """[n, 20]: the monomials of RPC00B at ground points."""
        x = (lon - self.long_off) / self.long_scale
        y = (lat - self.lat_off) / self.lat_scale
        z = (height - self.height_off) / self.height_scale
        terms = (np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x, y * y, z * z)
        cubic = (x * y * z, x**3, x * y * y, x * z * z, x * x * y, y**3, y * z * z, x * x * z)
        return np.stack([*terms, *cubic, y * y * z, z**3], axis=-1)

    def packed(self) -> Floats:
        """float64[90]: what :meth:`SensorModel.packed` begins with."""
        scalars = [getattr(self, name) for name in SCALARS]
        samp, line = (
            (self.samp_num_coeff, self.samp_den_coeff),
            (self.line_num_coeff, self.line_den_coeff),
        )
        return np.concatenate([scalars, *samp, *line])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists under the field names (those of RPC00B in lower case)."""
        scalars = {name: getattr(self, name) for name in SCALARS}
        return scalars | {name: getattr(self, name).tolist() for name in VECTORS}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> RPC:
        """The inverse of :meth:`to_dict`; other keys are ignored."""
        missing = [name for name in (*SCALARS, *VECTORS) if name not in values]
        if missing:
            raise ValueError(f"{', '.join(missing)} missing")
        return cls(**{name: values[name] for name in (*SCALARS, *VECTORS)})


def line_weights(rows: tuple[float, float], count: int, row: ArrayLike) -> Floats:
    """[..., count]: weights of the coefficients at lines ``row`` of the domain ``rows``, px."""
    row = np.asarray(row, dtype=np.float64)
    s = np.clip((row - rows[0]) / (rows[1] - rows[0]), 0.0, 1.0) * (count - 3)
    first = np.minimum(np.floor(s).astype(np.int64), count - 4)
    dense = np.zeros((*row.shape, count))
    for a, weight in enumerate(cubic_weights(s - first)):
        np.put_along_axis(dense, (first + a)[..., None], weight[..., None], axis=-1)
    return dense


@dataclass(frozen=True, eq=False)
class LineCorrection:
    """See MEANING: ``rows`` (row_min, row_max) px; ``coefficients`` float64[2, n] px of C and R.

    Raises ValueError unless they are finite and there are four of each or more.
    """

    rows: tuple[float, float]
    coefficients: Floats

    def __post_init__(self) -> None:
        values = np.array(self.coefficients, dtype=np.float64)
        if values.ndim != 2 or len(values) != 2 or values.shape[1] < 4:
            raise ValueError("a correction by line has two splines of four coefficients or more")
        if not np.isfinite([*self.rows, *values.ravel()]).all() or self.rows[0] >= self.rows[1]:
            raise ValueError("a correction by line must be finite, and have lines")
        values.setflags(write=False)
        object.__setattr__(self, "coefficients", values)

    def at(self, row: ArrayLike) -> Floats:
        """(C, R) [2, ...] px at lines ``row`` of the smooth sensor."""
        weights = line_weights(self.rows, self.coefficients.shape[1], np.nan_to_num(row))
        found = np.moveaxis(weights @ self.coefficients.T, -1, 0)
        return np.where(np.isfinite(row), found, np.nan)

    def add(self, col: Floats, row: Floats) -> tuple[Floats, Floats]:
        """Position in the image of a position (col, row) of the smooth sensor, px."""
        along, across = self.at(row)
        return col + along, row + across

    def take(self, col: ArrayLike, row: ArrayLike) -> tuple[Floats, Floats]:
        """The inverse of :meth:`add`; arrays broadcast."""
        col, row = np.broadcast_arrays(np.asarray(col, float), np.asarray(row, float))
        smooth = row
        for _ in range(ROUNDS):
            last, smooth = smooth, row - self.at(smooth)[1]
            if not np.nanmax(np.abs(smooth - last), initial=0.0) > 1e-10:
                break
        return col - self.at(smooth)[0], smooth

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, in the words of MEANING."""
        return {
            "row_min": self.rows[0],
            "row_max": self.rows[1],
            "col": self.coefficients[0].tolist(),
            "row": self.coefficients[1].tolist(),
            "meaning": MEANING,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> LineCorrection:
        """The inverse of :meth:`to_dict`."""
        rows = float(values["row_min"]), float(values["row_max"])
        return cls(rows, np.array([values["col"], values["row"]], dtype=np.float64))


@dataclass(frozen=True, eq=False)
class SensorModel:
    """An RPC and the affine that brings its image coordinates to the true ones.

    ``affine`` is float64[2, 3]: (col, row) = affine @ (col_rpc, row_rpc, 1), px, which is the true
    position but for a correction ``by_line``, if there is one.
    """

    rpc: RPC
    affine: Floats = field(default_factory=lambda: np.array(IDENTITY))
    by_line: LineCorrection | None = None

    def __post_init__(self) -> None:
        affine = np.array(self.affine, dtype=np.float64)
        if affine.shape != (2, 3) or not np.isfinite(affine).all():
            raise ValueError("affine must be 2 x 3 finite numbers")
        if abs(np.linalg.det(affine[:, :2])) < 1e-9:
            raise ValueError("affine is singular")
        affine.setflags(write=False)
        object.__setattr__(self, "affine", affine)
        packed = np.concatenate([self.rpc.packed(), affine.reshape(-1)])
        object.__setattr__(self, "_packed", packed)

    def packed(self) -> Floats:
        """float64[96] for the kernels: ``RPC.packed()``, then the affine's rows (a copy).

        The kernels know the smooth sensor alone.
        """
        return self._packed.copy()

    @property
    def smooth(self) -> SensorModel:
        """The sensor without its correction by line."""
        return self if self.by_line is None else SensorModel(self.rpc, self.affine)

    def project(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> tuple[Floats, Floats]:
        """True image (col, row) in px of ground points (degrees, degrees, m); arrays broadcast."""
        return self.shown_at(*_batch(project_points, self._packed, lon, lat, height))

    def shown_at(self, col: Floats, row: Floats) -> tuple[Floats, Floats]:
        """Where the image has what the smooth sensor has at (col, row), px."""
        return (col, row) if self.by_line is None else self.by_line.add(col, row)

    def localize(self, col: ArrayLike, row: ArrayLike, height: ArrayLike) -> tuple[Floats, Floats]:
        """Ground (lon, lat) in degrees of true image points at ellipsoidal heights in m.

        Arrays broadcast. NaN where the search does not converge.
        """
        if self.by_line is not None:
            col, row = self.by_line.take(col, row)
        return _batch(localize_points, self._packed, col, row, height)

    def corrected_rpc(self) -> tuple[RPC, float]:
        """One RPC with the affine folded in, for software that knows RPCs only.

        Denominators are kept and numerators refitted by linear least squares over the RPC's ground
        box. It cannot hold a correction by line, which is part of its difference. Returns the RPC
        and its largest difference from this model in px, on points that did not make the fit.
        """
        rpc = self.rpc
        lon0, lat0, lon1, lat1, h0, h1 = rpc.ground_box

        def grid(n: int, inset: float) -> tuple[Floats, Floats, Floats]:
            t = np.linspace(inset, 1 - inset, n)
            lon, lat, h = np.meshgrid(
                lon0 + t * (lon1 - lon0), lat0 + t * (lat1 - lat0), h0 + t * (h1 - h0)
            )
            return lon.ravel(), lat.ravel(), h.ravel()

        lon, lat, h = grid(13, 0.0)
        terms = rpc.terms(lon, lat, h)
        samp_off, line_off = self.affine @ (rpc.samp_off, rpc.line_off, 1.0)
        col, row = self.smooth.project(lon, lat, h)
        fitted = {}
        for name, values, offset, scale, denominator in (
            ("samp", col, samp_off, rpc.samp_scale, rpc.samp_den_coeff),
            ("line", row, line_off, rpc.line_scale, rpc.line_den_coeff),
        ):
            weighted = terms / (terms @ denominator)[:, None]
            fitted[f"{name}_num_coeff"] = np.linalg.lstsq(
                weighted, (values - offset) / scale, rcond=1e-15
            )[0]
        corrected = RPC.from_dict(
            rpc.to_dict() | fitted | {"samp_off": samp_off, "line_off": line_off}
        )
        check = grid(12, 0.04)
        wanted, got = np.array(self.project(*check)), np.array(corrected.project(*check))
        return corrected, float(np.abs(wanted - got).max())

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: the RPC's fields and the affine, with a line on its meaning."""
        return {
            "rpc": self.rpc.to_dict(),
            "affine": self.affine.tolist(),
            "affine_meaning": "(col, row)_image = affine @ (col_rpc, row_rpc, 1), px",
        } | of_record(self.by_line)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SensorModel:
        """The inverse of :meth:`to_dict`."""
        affine = np.array(values["affine"], dtype=np.float64)
        return cls(RPC.from_dict(values["rpc"]), affine, read_correction(values))


def read_correction(values: Mapping[str, Any]) -> LineCorrection | None:
    """The correction of a record of :func:`of_record`; None if it has none."""
    return LineCorrection.from_dict(values["by_line"]) if "by_line" in values else None


def of_record(by_line: LineCorrection | None) -> dict[str, Any]:
    """What a record has of a correction: nothing without one."""
    return {} if by_line is None else {"by_line": by_line.to_dict()}
