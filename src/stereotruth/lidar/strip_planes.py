"""Heights of two strips of a LiDAR compared on planes that both have measured.

A cell of the point stores is divided into squares. Where the single returns of a strip in a square
lie on a plane, the plane is taken; where two strips have one, the planes differ by

    d = dz - g · (dx, dy),

with (dx, dy, dz) the offset of the second strip from the first and g the slope of the ground or
roof: level planes tell the offset in height, tilted ones that in plan (the measure of the quality
of LiDAR swaths by ASPRS, "Guidelines on Geometric Inter-Swath Accuracy and Quality of Lidar Data",
2018; Latypov 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import exact_metres_per_degree
from ..core.numerics.statistics import TUKEY, robust_sigma, tukey_weights
from .lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from .point_store import Points

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SQUARES = (64, 32, 16)  # along a side of a cell, of 1.8, 3.7, 7.3 m; as small as points allow
EXPECTED = 12.0  # points of the sparser strip in a square
LEAST_POINTS = 8
PLANE = 2.0  # times the residuals of a strip's evener squares: four standard errors of their rms
EVENER = 0.25  # quantile of the squares' rms
SAME_SLOPE = 13.8  # χ² of two slopes of one plane that 0.1 % exceed
LEAST_NOISE_M = 0.005  # of heights: steps of files of 1 cm and less
# Twice the repeatability on smooth surfaces that the USGS Lidar Base Specification asks of its
# quality level 2: what is rougher are plants and rubble
MOST_NOISE_M = 0.12
MOST = 64  # tilted planes of a cell that are kept of two strips, the steepest, and as many others
TILTED = 4.0  # standard deviations of a slope from which noise does not choose the steepest
MOVES = (3, 4, 5, 9)  # water, and plants by height: they move, or let pulses pass
PRIOR_M = 1.0  # standard deviation of an offset in plan before anything is known of it
ROUNDS = 50
LEAST_GROUPS = 6  # from which three unknowns and their scatter are told
GROUPS = 8  # along a side of a cell: planes of 15 m share their errors


class Planes(NamedTuple):
    """Planes of a strip in the squares of a cell [n]: number of the square, points, rms of their
    residuals, middle [n, 3] (m in the cell), slope [n, 2], inverse of the scatter [n, 2, 2]."""

    square: Ints
    points: Floats
    rms: Floats
    middle: Floats
    slope: Floats
    inverse: Floats

    def taken(self, chosen: NDArray) -> Planes:
        """The planes of an index or a mask."""
        return Planes(*(values[chosen] for values in self))


def squares_along(counts: list[Ints]) -> int:
    """Squares along a cell's side, by the points that each strip has in each of its SQUARES[-1]²
    largest squares."""
    sparsest = min(float(of[of > 0].mean()) for of in counts)
    for squares in SQUARES[:-1]:
        if sparsest >= EXPECTED * (squares // SQUARES[-1]) ** 2:
            return squares
    return SQUARES[-1]


def metres_in_cell(points: Points, row: int, col: int) -> Floats:
    """East, north from the cell's south-west corner and height [n, 3], m."""
    per_degree = exact_metres_per_degree((row + 0.5) * (1 << CELL_BITS) * LATTICE_DEG, 0.0)
    east = (points.lon_q - (col << CELL_BITS)) * LATTICE_DEG * per_degree[0]
    north = (points.lat_q - (row << CELL_BITS)) * LATTICE_DEG * per_degree[1]
    return np.stack([east, north, points.h_q * LATTICE_M], axis=1)


def is_firm(points: Points) -> NDArray[np.bool_]:
    """Which points may lie on planes that stay: single returns, not of water or plants."""
    return (points.number_of_returns <= 1) & ~np.isin(points.classification, MOVES)


def planes_of(points: Points, at: Floats, row: int, col: int, squares: int) -> Planes:
    """The planes that points of one strip lie on; ``at``: see :func:`metres_in_cell`."""
    shift = CELL_BITS - squares.bit_length() + 1
    x, y = ((q - (k << CELL_BITS)) >> shift for q, k in ((points.lon_q, col), (points.lat_q, row)))
    square, total = y * squares + x, squares**2
    n = np.bincount(square, minlength=total).astype(np.float64)
    held = np.flatnonzero(n >= LEAST_POINTS)
    middle = np.stack([np.bincount(square, at[:, k], total) for k in range(3)], axis=1)
    middle /= np.maximum(n, 1.0)[:, None]
    off = at - middle[square]
    sums = {
        (i, j): np.bincount(square, off[:, i] * off[:, j], total)[held]
        for i in range(3)
        for j in range(i, 3)
    }
    xx, xy, yy, xz, yz = (sums[k] for k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)))
    determinant = xx * yy - xy**2
    spread = determinant > 0.05 * (xx + yy) ** 2 / 4  # else points of a line
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.stack([yy, -xy, -xy, xx], axis=1) / determinant[:, None]
        slope = np.stack([yy * xz - xy * yz, xx * yz - xy * xz], axis=1) / determinant[:, None]
        squared = sums[2, 2] - slope[:, 0] * xz - slope[:, 1] * yz
        rms = np.sqrt(np.maximum(squared, 0.0) / (n[held] - 3.0))
    found = Planes(held, n[held], rms, middle[held], slope, inverse.reshape(-1, 2, 2)).taken(spread)
    if not found.square.size:
        return found
    noise = max(float(np.quantile(found.rms, EVENER)), LEAST_NOISE_M)
    found = found.taken(found.rms <= min(PLANE * noise, MOST_NOISE_M))
    return found._replace(rms=np.maximum(found.rms, noise))


class Differences(NamedTuple):
    """Planes of two strips compared [n]: height of the second less that of the first (m), slope
    [n, 2], variances of both [n] and [n, 2, 2], number of the group of planes nearby."""

    height: Floats
    slope: Floats
    variance: Floats
    slope_variance: Floats
    group: Ints


def compare(first: Planes, second: Planes, squares: int, cell: int) -> Differences:
    """Planes of two strips in the squares of a cell that both have; ``cell``: its number."""
    _, a, b = np.intersect1d(first.square, second.square, return_indices=True)
    a, b = first.taken(a), second.taken(b)
    covariance = [p.rms[:, None, None] ** 2 * p.inverse for p in (a, b)]
    both = covariance[0] + covariance[1]
    apart = b.slope - a.slope
    with np.errstate(invalid="ignore", divide="ignore"):
        chi_square = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(both), apart)
    same = chi_square < SAME_SLOPE
    a, b, both = a.taken(same), b.taken(same), both[same]
    place = (a.middle[:, :2] + b.middle[:, :2]) / 2
    height, variance = np.zeros(len(place)), np.zeros(len(place))
    for sign, p in ((-1.0, a), (1.0, b)):
        away = place - p.middle[:, :2]
        height += sign * (p.middle[:, 2] + np.einsum("ni,ni->n", p.slope, away))
        leverage = np.einsum("ni,nij,nj->n", away, p.inverse, away)
        variance += p.rms**2 * (1.0 / p.points + leverage)
    slope = (a.slope + b.slope) / 2
    y, x = np.divmod(a.square, squares)
    group = (cell * GROUPS + y * GROUPS // squares) * GROUPS + x * GROUPS // squares
    found = Differences(height, slope, variance, both / 4, group)
    if len(height) <= 2 * MOST:
        return found
    steep = np.einsum("ni,ni->n", slope, slope)
    steep[steep < TILTED**2 * np.trace(both, axis1=1, axis2=2) / 4] = 0.0
    order = np.argsort(-steep, kind="stable")
    first = min(MOST, np.count_nonzero(steep))
    others = np.sort(order[first:])
    kept = np.concatenate([order[:first], others[:: -(-others.size // (2 * MOST - first))]])
    return Differences(*(values[np.sort(kept)] for values in found))


@dataclass(frozen=True, eq=False)
class Offset:
    """Offset of a strip from another, east, north, up (m), with its covariance [3, 3] (m²), from
    so many planes in so many ``groups`` of planes nearby."""

    value: Floats
    covariance: Floats
    planes: int
    groups: int


def offset_of(parts: list[Differences]) -> Offset | None:
    """The offset that the planes of two strips tell; None where too few are compared.

    Least squares with Tukey's weights. Slopes have errors themselves, which would draw the offset
    in plan towards 0: their variance is taken from the normal equations. The covariance is that of
    the residuals by groups of planes nearby.
    """
    d = Differences(*(np.concatenate(values) for values in zip(*parts)))
    if d.height.size < LEAST_POINTS:
        return None
    design = np.column_stack([-d.slope, np.ones(d.height.size)])
    prior = np.diag([PRIOR_M**-2, PRIOR_M**-2, 0.0])
    noise = np.zeros((d.height.size, 3, 3))
    noise[:, :2, :2] = d.slope_variance
    value = np.array([0.0, 0.0, float(np.median(d.height))])
    spread = d.variance
    for _ in range(ROUNDS):
        residual = d.height - design @ value
        scale = robust_sigma(residual / np.sqrt(spread), 1.0)
        weight = tukey_weights(residual / np.sqrt(spread) / scale) / (spread * scale**2)
        normal = prior + np.einsum("n,ni,nj->ij", weight, design, design)
        corrected = normal - np.einsum("n,nij->ij", weight, noise)
        if np.linalg.eigvalsh(corrected - prior)[0] <= 0.0:  # slopes that noise explains
            corrected = normal
        step = np.linalg.solve(corrected, design.T @ (weight * residual) - prior @ value)
        value = value + step
        if np.abs(step).max() < 1e-6:
            break
    distinct, which = np.unique(d.group, return_inverse=True)
    if distinct.size < LEAST_GROUPS:
        return None
    scores = (weight * residual)[:, None] * design
    groups = np.stack([np.bincount(which, scores[:, k]) for k in range(3)], axis=1)
    inverse = np.linalg.inv(corrected)
    meat = groups.T @ groups * len(groups) / (len(groups) - 3) + prior
    used = np.abs(residual / np.sqrt(spread) / scale) < TUKEY
    return Offset(value, inverse @ meat @ inverse, int(used.sum()), len(groups))
