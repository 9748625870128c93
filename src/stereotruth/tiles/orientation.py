"""The orientation file of a tile: from its pixels back to the original images and to heights.

Whoever has the file needs none of this code: the mappings are polynomials in normalised
coordinates, with their measured errors, beside the RPCs and the epipolar model themselves.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import for_readers, metres_per_degree

Model = (
    Any  # stereotruth.epipolar.model.EpipolarModel, which whoever reads such a file need not have
)


RING_SIDE = 8  # points of the footprint per side of the tile
HEIGHT_MARGIN_M = 100.0  # predictions go beyond the labels: the height formula holds that far
PIXEL_TOLERANCE = 0.002  # px; GF-7-like geometry over 1024 px leaves less at degree 3
GROUND_TOLERANCE = {"lon": 1e-8, "lat": 1e-8, "height": 0.01}  # degrees (1 mm), degrees, m

CONVENTIONS = {
    "pixel": "(x, y) = (column, row); (0, 0) is the centre of the upper-left pixel",
    "disparity": "d = x_left - x_right in px of the tile pair; the match of left pixel (x, y) is "
    "right pixel (x - d, y)",
    "right_offset_px": "the right tile is the right epipolar image from column "
    "col0 - right_offset_px on, so that the disparity of the scene is d + right_offset_px",
    "ground": "WGS 84 longitude and latitude in degrees, height above the WGS 84 ellipsoid in m",
    "polynomial": "t_k = (input_k - input_offset_k) / input_scale_k; output = output_offset + "
    "output_scale * sum over terms of coefficient * prod_k t_k ** exponent_k",
    "height": "of the surface that the label stands for (top of what the LiDAR saw in the pixel)",
}

VIEWS = {  # by the epipolar model's view_order
    "left looks backward": "left: reference, the backward view; right: the forward view",
    "left looks forward": "left: reference, the forward view; right: the backward view",
    "across track": "left: reference; right: the other view, across the flight direction",
}


OF_LINES = (
    "The attitude jitters: where sensor_model has by_line, that (col, row) is of the smooth "
    "sensor, and the image as delivered shows it at (col, row) + (C(row), R(row)), as "
    "by_line.meaning says."
)


def _monomials(t: Floats, exponents: NDArray[np.intp]) -> Floats:
    """Terms [n, m] of normalised inputs [k, n] for exponents [m, k]."""
    return np.prod(t.T[:, None, :] ** exponents[None], axis=2)


def evaluate(polynomial: Mapping[str, Any], *inputs: ArrayLike) -> dict[str, Floats]:
    """Outputs by name of a polynomial of an orientation file; inputs in its order."""
    arrays = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in inputs))
    t = np.stack([a.ravel() for a in arrays])
    offset, scale = (np.array(polynomial[f"input_{k}"])[:, None] for k in ("offset", "scale"))
    terms = _monomials((t - offset) / scale, np.array(polynomial["exponents"]))
    return {
        name: (
            polynomial["output_offset"][name]
            + polynomial["output_scale"][name] * (terms @ np.array(coefficients))
        ).reshape(arrays[0].shape)
        for name, coefficients in polynomial["coefficients"].items()
    }


def _middle(values: Floats) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low + high) / 2.0, max((high - low) / 2.0, 1e-12)


def fit(
    inputs: Mapping[str, Floats],
    outputs: Mapping[str, Floats],
    check_inputs: Sequence[Floats],
    check_outputs: Sequence[Floats],
    tolerance: Mapping[str, float],
) -> dict[str, Any]:
    """Least-squares polynomial of degree 3, or up to 5 where 3 misses the tolerance.

    All arrays are flat; the check points take no part in the fit and give ``max_error``.
    """
    names = list(outputs)
    offset, scale = zip(*(_middle(values) for values in inputs.values()))
    t = (np.stack(list(inputs.values())) - np.array(offset)[:, None]) / np.array(scale)[:, None]
    for degree in (3, 4, 5):
        every = itertools.product(range(degree + 1), repeat=len(inputs))
        low = [e for e in every if sum(e) <= degree]
        exponents = np.array(sorted(low, key=lambda e: (sum(e), e)))
        terms = _monomials(t, exponents)
        record: dict[str, Any] = {
            "inputs": list(inputs),
            "outputs": names,
            "degree": degree,
            "input_offset": list(offset),
            "input_scale": list(scale),
            "output_offset": {},
            "output_scale": {},
            "exponents": exponents.tolist(),
            "coefficients": {},
        }
        for name, values in outputs.items():
            middle, half = _middle(values)
            solution = np.linalg.lstsq(terms, (values - middle) / half, rcond=None)[0]
            record["output_offset"][name] = middle
            record["output_scale"][name] = half
            # 1e-11 of a tile: far below any error here, and the same text on every machine.
            record["coefficients"][name] = [round(float(c), 11) + 0.0 for c in solution]
        got = evaluate(record, *check_inputs)
        error = {n: float(np.abs(got[n] - v).max()) for n, v in zip(names, check_outputs)}
        # Below a thousandth of the tolerance it is the rounding of this machine.
        record["max_error"] = {
            n: float(f"{max(e, tolerance[n] / 1000):.2g}") for n, e in error.items()
        }
        if all(error[n] <= tolerance[n] for n in names):
            break
    return record


def _nodes(low: float, high: float, count: int) -> Floats:
    """Chebyshev points of [low, high], which keep a least-squares fit even up to the border."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    return (low + high) / 2.0 - (high - low) / 2.0 * np.cos(angle)


def _mesh(*axes: Floats) -> list[Floats]:
    return [a.ravel() for a in np.meshgrid(*axes, indexing="ij")]


def view_polynomials(
    to_sensor: Any, row0: int, col0: int, size: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tile px (x, y) to sensor px (col, row), and back, of one view.

    ``to_sensor`` maps epipolar (x, y) to sensor (col, row); (row0, col0) is the window's upper-
    left pixel in that view's epipolar image.
    """
    low, high = -0.5, size - 0.5
    x, y = _mesh(_nodes(low, high, 10), _nodes(low, high, 10))
    cx, cy = _mesh(np.linspace(low, high, 9), np.linspace(low, high, 9))
    col, row = to_sensor(x + col0, y + row0)
    ccol, crow = to_sensor(cx + col0, cy + row0)
    pixel = dict.fromkeys(("col", "row", "x", "y"), PIXEL_TOLERANCE)
    forth = fit({"x": x, "y": y}, {"col": col, "row": row}, (cx, cy), (ccol, crow), pixel)
    back = fit({"col": col, "row": row}, {"x": x, "y": y}, (ccol, crow), (cx, cy), pixel)
    return forth | {"unit": "px"}, back | {"unit": "px"}


def ground_polynomial(
    model: Model,
    row0: int,
    col0: int,
    size: int,
    offset: int,
    heights: tuple[float, float],
) -> dict[str, Any]:
    """(x, y, d) of a tile to (lon, lat, height) for surfaces between two heights in m."""
    low, high = -0.5, size - 0.5

    def samples(x: Floats, y: Floats, h: Floats) -> tuple[list[Floats], list[Floats]]:
        lon, lat = model.epipolar_to_ground(x + col0, y + row0, h)
        x_left, _, x_right, _ = model.ground_to_epipolar(lon, lat, h)
        return [x, y, x_left - x_right - offset], [lon, lat, h]

    inputs, outputs = samples(
        *_mesh(_nodes(low, high, 7), _nodes(low, high, 7), _nodes(*heights, 7))
    )
    side = np.linspace(low, high, 6)
    check = samples(*_mesh(side, side, np.linspace(*heights, 6)))
    names = ("lon", "lat", "height")
    record = fit(
        dict(zip(("x", "y", "d"), inputs)), dict(zip(names, outputs)), *check, GROUND_TOLERANCE
    )
    disparity = [round(float(f(check[0][2])), 3) for f in (np.min, np.max)]
    return record | {
        "units": {"x": "px", "y": "px", "d": "px", "lon": "deg", "lat": "deg", "height": "m"},
        "height_range_m": [round(float(h), 3) for h in heights],
        "disparity_range_px": disparity,
    }


def footprint(
    model: Model, row0: int, col0: int, size: int, height: NDArray[np.floating]
) -> tuple[Floats, Floats]:
    """Ring of a left tile's border on the ground: lon, lat [4 k, 2] in degrees, heights [4 k] in m.

    Each border point lies at the nearest height of ``height`` [size, size] (NaN: none; all NaN:
    the model's reference height). Upper left, upper right, lower right, lower left; not closed.
    """
    t = np.linspace(-0.5, size - 0.5, RING_SIDE + 1)[:-1]
    far, near = np.full_like(t, size - 0.5), np.full_like(t, -0.5)
    x = np.concatenate([t, far, size - 1.0 - t, near])
    y = np.concatenate([near, t, far, size - 1.0 - t])
    step = max(1, size // 128)  # every eighth pixel of a tile of 1024: quick, and near enough
    rows, cols = np.nonzero(np.isfinite(height[::step, ::step]))
    if rows.size:
        rows, cols = rows * step, cols * step
        nearest = np.argmin((x[:, None] - cols) ** 2 + (y[:, None] - rows) ** 2, axis=1)
        heights = height[rows[nearest], cols[nearest]].astype(np.float64)
    else:
        heights = np.full(x.shape, float(model.reference_height))
    lon, lat = model.epipolar_to_ground(x + col0, y + row0, heights)
    return np.stack([lon, lat], axis=1), heights


def sensor_record(sensor: Any) -> dict[str, Any]:
    """Sensor model of one image, and the one RPC that stands for it, with its measured error."""
    rpc, error = sensor.corrected_rpc()
    return {
        "sensor_model": sensor.to_dict(),
        "corrected_rpc": rpc.to_dict(),
        "corrected_rpc_max_error_px": float(f"{error:.2g}"),
    }


def orientation(
    model: Model,
    sensors: Mapping[str, Mapping[str, Any]],
    *,
    row0: int,
    col0: int,
    size: int,
    offset: int,
    height: NDArray[np.floating],
    disparity: NDArray[np.floating],
) -> dict[str, Any]:
    """The geometry of one tile as JSON-ready values.

    ``sensors``: :func:`sensor_record` by view. ``height`` [size, size] in m and ``disparity``
    [size, size] in px of the tile (offset removed), both NaN where there is no label.
    """
    ring, ring_heights = footprint(model, row0, col0, size, height)
    finite = height[np.isfinite(height)]
    low, high = (float(v) for v in model.height_range)
    if finite.size:
        tops = float(finite.min()), float(finite.max())
        low = min(max(low, tops[0] - HEIGHT_MARGIN_M), tops[0])
        high = max(min(high, tops[1] + HEIGHT_MARGIN_M), tops[1])
    if high - low < 1.0:
        low, high = low - 0.5, high + 0.5
    ground = ground_polynomial(model, row0, col0, size, offset, (low, high))
    views = {}
    for view, to_sensor, first in (
        ("left", model.left_image.smooth.inverse, col0),
        ("right", model.right_image.smooth.inverse, col0 - offset),
    ):
        forth, back = view_polynomials(to_sensor, row0, first, size)
        views[view] = {"tile_to_sensor": forth, "sensor_to_tile": back, **sensors[view]}
    ring = np.column_stack([for_readers(ring[:, 0]), ring[:, 1:]])
    coordinates = [[round(float(v), 9) for v in point] for point in (*ring, ring[0])]
    return {
        "window": {"row0": row0, "col0": col0, "size": size, "unit": "px of the epipolar grid"},
        "right_offset_px": offset,
        "conventions": CONVENTIONS | {"views": VIEWS[model.report["view_order"]]},
        "to_heights": _recipe(model, views, ground, offset, height, disparity),
        "ground": ground,
        **views,
        "footprint": {
            "type": "Polygon",
            "coordinates": [coordinates],
            "heights_m": [round(float(h), 2) for h in (*ring_heights, ring_heights[0])],
            "meaning": "border of the left tile at the heights of the surface, lon, lat",
        },
        "epipolar": model.to_dict(),
    }


def _recipe(
    model: Model,
    views: Mapping[str, Any],
    ground: Mapping[str, Any],
    offset: int,
    height: NDArray[np.floating],
    disparity: NDArray[np.floating],
) -> list[str]:
    """How to go back to heights and to the originals, with one pixel of the tile as example."""
    steps = [
        "Height: put (x, y, d) of a left pixel into ground.coefficients as conventions.polynomial "
        "says; out come longitude, latitude and height. Valid for d within "
        "ground.disparity_range_px.",
        "Original images: left.tile_to_sensor at (x, y) and right.tile_to_sensor at (x - d, y) "
        "give (col, row) in the two images as delivered; sensor_to_tile goes back.",
        *([OF_LINES] if model.has_lines else []),
        "By rays instead: those two (col, row) and the two corrected_rpc, intersected in space "
        "by any photogrammetric software, give the same point.",
    ]
    rows, cols = np.nonzero(np.isfinite(disparity) & np.isfinite(height))
    if rows.size:
        middle = (height.shape[0] - 1) / 2.0
        k = int(np.argmin((rows - middle) ** 2 + (cols - middle) ** 2))
        x, y, d = int(cols[k]), int(rows[k]), float(disparity[rows[k], cols[k]])
        point = evaluate(ground, x, y, d)
        at = evaluate(views["left"]["tile_to_sensor"], x, y)
        there = evaluate(views["right"]["tile_to_sensor"], x - d, y)
        left, right = (
            dict(zip(("col", "row"), sensor.shown_at(place["col"], place["row"])))
            for sensor, place in ((model.left, at), (model.right, there))
        )
        steps.append(
            f"Example: left pixel ({x}, {y}) has d = {d:.4f} px, so its match is ({x - d:.4f}, "
            f"{y}) of the right tile, and d in the scene is {d + offset:.4f} px. The formula "
            f"gives lon {float(point['lon']):.8f}, lat {float(point['lat']):.8f}, height "
            f"{float(point['height']):.2f} m (the LiDAR's highest point in that pixel: "
            f"{float(height[y, x]):.2f} m). In the originals: left ({float(left['col']):.2f}, "
            f"{float(left['row']):.2f}), right ({float(right['col']):.2f}, "
            f"{float(right['row']):.2f})."
        )
    return steps


def save(path: Path, record: Mapping[str, Any]) -> None:
    """Write an orientation file: indented, each list of numbers on one line."""
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
    flat = re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", lambda m: f"[{' '.join(m[1].split())}]", text)
    path.write_text(flat + "\n", encoding="utf-8")


@dataclass(frozen=True)
class PixelSize:
    """Metres of one px: ``ground_m`` along a row, ``height_m`` for one px of disparity."""

    ground_m: float
    height_m: float

    @property
    def base_to_height(self) -> float:
        """Parallax on the ground for one metre of height."""
        return self.ground_m / self.height_m

    @classmethod
    def of(cls, orientation: Mapping[str, Any]) -> PixelSize:
        """In the middle of a tile and of its disparities, by its orientation record."""
        ground = orientation["ground"]
        middle = orientation["window"]["size"] / 2
        low, high = ground["disparity_range_px"]
        d = (low + high) / 2
        below, above = (evaluate(ground, middle, middle, d + k)["height"] for k in (-0.5, 0.5))
        a, b = (evaluate(ground, middle + k, middle, d) for k in (-0.5, 0.5))
        degrees = b["lon"] - a["lon"], b["lat"] - a["lat"]
        return cls(math.hypot(*(degrees * metres_per_degree(a["lat"]))), float(above - below))

    @classmethod
    def mean(cls, orientations: Iterable[Path]) -> PixelSize | None:
        """Of several tiles' orientation files, those that are there; None of none."""
        found = [
            cls.of(json.loads(file.read_text(encoding="utf-8")))
            for file in orientations
            if file.is_file()
        ]
        if not found:
            return None
        return cls(fmean(p.ground_m for p in found), fmean(p.height_m for p in found))
