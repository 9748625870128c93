"""The epipolar model of a scene: from image to epipolar grid and back, and its JSON file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.products.files import atomic_file, read_record, sealed
from ..sensor.line_correction import LineCorrection, of_record, read_correction
from ..sensor.rpc import SensorModel
from .spline_kernels import POWERS, ground_points_to_epipolar, map_points

Floats = NDArray[np.float64]


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
        ends = [
            self.forward(np.add(col, a), np.add(row, b))
            for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ]
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
    lat_max) degrees, what the virtual points covered; ``report``: how good the model is.
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "_sensors", np.stack([self.left.packed(), self.right.packed()]))

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
            self._sensors, self.left_image.packed, self.right_image.packed, lon, lat, height, out
        )
        return out

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where the left image's ray meets an ellipsoidal height in m."""
        return self.left.localize(*self.epipolar_to_left(x, y), height)

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
