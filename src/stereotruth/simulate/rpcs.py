"""RPC00B coefficients fitted to the rigorous camera, with an affine bias as real ones have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .camera import locate
from .geodesy import LocalFrame


@dataclass(frozen=True)
class FittedRPC:
    """RPC00B metadata; ``bias`` float64[2, 3] maps true (col, row, 1) to what the RPCs predict.

    ``numbers``: line_off, samp_off, lat_off, long_off, height_off and the five scales in that
    order. ``coefficients`` float64[4, 20]: line_num, line_den, samp_num, samp_den. Residuals in
    px, on points that did not make the fit.
    """

    numbers: tuple[float, ...]
    coefficients: np.ndarray
    bias: np.ndarray
    rms_px: float
    max_px: float


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
    return FittedRPC(
        (offset[1], offset[0], lat_off, lon_off, h_off,
         scale[1], scale[0], lat_scale, lon_scale, h_scale),
        np.stack([*line, *samp]),
        bias,
        float(np.sqrt((miss**2).sum(axis=1).mean())),
        float(np.abs(miss).max()),
    )  # fmt: skip
