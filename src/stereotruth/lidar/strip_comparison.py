"""Strips of a site's LiDAR compared where they overlap: what each is off from the others.

Where two strips have a plane of single returns in a square, these differ by d = dz - g · (dx, dy),
with the offset (dx, dy, dz) of the second strip and the slope g (ASPRS, "Guidelines on Geometric
Inter-Swath Accuracy and Quality of Lidar Data", 2018; Latypov 2002). One adjustment of all pairs
gives each strip's offset from the one with most ground. See docs/explanation/real_sensors.md.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from ..core.numerics.arrays import Floats, Ints
from ..core.numerics.geometry import DEGREE_M, exact_metres_per_degree
from ..core.numerics.statistics import robust_sigma, tukey_weights
from .lattice import CELL_BITS, CELL_DEG, LATTICE_DEG, LATTICE_M
from .point_fields import BIN_S, EDGES, SOURCE, TIME, runs_of
from .point_store import SQUARES as CELL_SQUARES
from .point_store import Points, PointStore
from .strips import SHARE, Strip, StripKey, StripOffsets, more_of

LEAST_SHARE = 0.002  # of a cell's points: fewer are compared with nothing
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
FALSE_REMARK = 0.01  # probability that strips of a site without offsets are named
SYSTEMATIC_M = (0.03, 0.03, 0.005)  # east, north, up: what pairs of strips that agree differ by


def compare_strips(stores: Sequence[PointStore]) -> StripOffsets:
    """What the strips of some point stores are off; of stores of one strip that alone.

    The order of the stores plays no part. Raises InputError if a store is damaged.
    """
    stores = sorted((s for s in stores if s.count), key=lambda s: s.path.name)
    keys = _Keys(stores)
    parts: dict[tuple[StripKey, StripKey], list[Differences]] = {}
    shares: list[tuple[int, int, StripKey, Ints]] = []
    cells = {cell for s in stores for cell in zip(s.cell_row.tolist(), s.cell_col.tolist())}
    for number, (row, col) in enumerate(sorted(cells) if keys.several else ()):
        points, which, own = keys.in_cell(row, col)
        square = _square_numbers(points, row, col, CELL_SQUARES)
        shares += [(row, col, key, _counts(square[which == k])) for k, key in enumerate(own)]
        if len(own) > 1:
            for pair, differences in _compared(points, which, own, row, col, number):
                parts.setdefault(pair, []).append(differences)
    ground = Counter[StripKey]()
    side_m = CELL_DEG / CELL_SQUARES * DEGREE_M
    for row, _, key, squares in shares:
        narrow = np.cos(np.radians((row + 0.5) * CELL_DEG))
        ground[key] += int((squares > 0).sum()) * side_m**2 * narrow
    names = keys.names
    flown = {key: round(area, 1) for key, area in ground.items()}
    flown = dict(sorted(flown.items(), key=lambda strip: (-strip[1], names[strip[0]])))
    number_of = {key: k for k, key in enumerate(flown)}
    table = np.zeros(len(shares), SHARE)
    for k, (row, col, key, squares) in enumerate(shares):
        table[k] = row, col, number_of[key], np.minimum(squares, 65535)
    compared = {
        (number_of[a], number_of[b]): offset
        for (a, b), of in sorted(parts.items(), key=lambda part: part[0])
        if (offset := offset_of(of)) is not None
    }
    return StripOffsets(_adjusted(flown, names, compared), table)


class _Keys:
    """The strips of stores: a key for each point, and a name for each key."""

    def __init__(self, stores: Sequence[PointStore]) -> None:
        self.stores = stores
        codes = {(s.strips_by, c) for s in stores for c in s.strip_counts}
        days = {day for store in stores for day in store.attrs["days"]}
        self.several = len(codes) > 1 or len(days) > 1
        steps = np.array(sorted({c for by, c in codes if by == TIME and c}), np.int64)
        first = runs_of(steps)
        last = {int(f): int(steps[first == f].max()) for f in np.unique(first)}
        self._runs = {int(step): (int(f), last[int(f)]) for step, f in zip(steps, first)}
        self._met: set[StripKey] = set()

    def _of(self, store: PointStore, code: int, day: int) -> StripKey:
        by = store.strips_by
        if by == TIME:
            return StripKey(by, *self._runs.get(code, (code, code)))
        return StripKey(by, code, code, more_of(store, day))

    def in_cell(self, row: int, col: int) -> tuple[Points, Ints, list[StripKey]]:
        """Points of a cell of all stores, the number of each one's strip, and the strips' keys."""
        points: list[Points] = []
        own: list[tuple[list[StripKey], Ints]] = []  # keys, and the number of each point's
        for store in self.stores:
            if (cell := store.cell_at(row, col)) is not None:
                points.append(store.points_of(cell))
                pairs = store.strips_of(cell).astype(np.int64) << 16 | points[-1].day
                distinct, which = np.unique(pairs, return_inverse=True)
                own.append(
                    ([self._of(store, int(p >> 16), int(p & 0xFFFF)) for p in distinct], which)
                )
        keys = sorted({key for some, _ in own for key in some})
        self._met.update(keys)
        numbers = [np.array([keys.index(key) for key in some])[which] for some, which in own]
        return Points.concatenate(points), np.concatenate(numbers), keys

    @property
    def names(self) -> dict[StripKey, str]:
        """What each strip that was met is called."""
        days = Counter((key.by, key.first) for key in self._met)
        return {key: _name(key, days[key.by, key.first] > 1) for key in self._met}


def _name(key: StripKey, on_days: bool) -> str:
    if key.by == SOURCE:
        return f"{key.first} of {key.more or 'no day'}" if on_days else str(key.first)
    if key.by == EDGES:
        return f"{key.first + 1} of {key.more}"
    return f"from {(key.first - 1) * BIN_S:.0f} s on" if key.first else "without time"


# ------------------------------------------------------------------ planes of a cell


def _square_numbers(points: Points, row: int, col: int, squares: int) -> Ints:
    """Number of the square of a cell that each point lies in, of ``squares`` along a side."""
    shift = CELL_BITS - squares.bit_length() + 1
    y, x = ((q - (k << CELL_BITS)) >> shift for q, k in ((points.lat_q, row), (points.lon_q, col)))
    return y * squares + x


def _counts(square: Ints) -> Ints:
    """Points in each of the CELL_SQUARES² squares of a cell, by the numbers of their squares."""
    counts = np.bincount(square, minlength=CELL_SQUARES**2)
    return counts.reshape(CELL_SQUARES, CELL_SQUARES)


def _compared(
    points: Points, which: Ints, keys: list[StripKey], row: int, col: int, number: int
) -> Iterator[tuple[tuple[StripKey, StripKey], Differences]]:
    """Every two strips of a cell on the planes that both have there.

    Of single returns, not of water or plants. ``number``: of the cell.
    """
    may_stay = (points.number_of_returns <= 1) & ~np.isin(points.classification, MOVES)
    points = Points(*(getattr(points, f.name)[may_stay] for f in fields(points)))
    which = which[may_stay]
    counts = np.bincount(which, minlength=len(keys))
    large = np.flatnonzero(counts > max(LEAST_SHARE * counts.sum(), 4 * LEAST_POINTS)).tolist()
    if len(large) < 2:
        return
    per_degree = exact_metres_per_degree((row + 0.5) * CELL_DEG, 0.0)
    east = (points.lon_q - (col << CELL_BITS)) * LATTICE_DEG * per_degree[0]
    north = (points.lat_q - (row << CELL_BITS)) * LATTICE_DEG * per_degree[1]
    xyz = np.stack([east, north, points.h_q * LATTICE_M], axis=1)  # m from the cell's corner
    square = _square_numbers(points, row, col, CELL_SQUARES)
    coarse = [_counts(square[which == k]) for k in large]
    sparsest = min(float(of[of > 0].mean()) for of in coarse)
    fine = (s for s in SQUARES if sparsest >= EXPECTED * (s // SQUARES[-1]) ** 2)
    squares = next(fine, SQUARES[-1])
    square = _square_numbers(points, row, col, squares)
    planes = {k: planes_of(square[which == k], xyz[which == k], squares**2) for k in large}
    for i, a in enumerate(large):
        for b in large[i + 1 :]:
            differences = compare(planes[a], planes[b], squares, number)
            if differences.height.size:
                yield (keys[a], keys[b]), differences


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


def planes_of(square: Ints, xyz: Floats, total: int) -> Planes:
    """The planes that points of one strip lie on.

    ``square``: that each point lies in, of ``total``; ``xyz`` [n, 3]: m from the cell's corner.
    """
    n = np.bincount(square, minlength=total).astype(np.float64)
    held = np.flatnonzero(n >= LEAST_POINTS)
    middle = np.stack([np.bincount(square, xyz[:, k], total) for k in range(3)], axis=1)
    middle /= np.maximum(n, 1.0)[:, None]
    off = xyz - middle[square]
    xx, xy, yy, xz, yz, zz = (
        np.bincount(square, off[:, i] * off[:, j], total)[held]
        for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    )
    determinant = xx * yy - xy**2
    spread = determinant > 0.05 * (xx + yy) ** 2 / 4  # else points of a line
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.stack([yy, -xy, -xy, xx], axis=1) / determinant[:, None]
        slope = np.stack([yy * xz - xy * yz, xx * yz - xy * xz], axis=1) / determinant[:, None]
        squared = zz - slope[:, 0] * xz - slope[:, 1] * yz
        rms = np.sqrt(np.maximum(squared, 0.0) / (n[held] - 3.0))
    planes = Planes(held, n[held], rms, middle[held], slope, inverse.reshape(-1, 2, 2))
    planes = planes.taken(spread)
    if not planes.square.size:
        return planes
    noise = max(float(np.quantile(planes.rms, EVENER)), LEAST_NOISE_M)
    planes = planes.taken(planes.rms <= min(PLANE * noise, MOST_NOISE_M))
    return planes._replace(rms=np.maximum(planes.rms, noise))


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
    differences = Differences(height, slope, variance, both / 4, group)
    if len(height) <= 2 * MOST:
        return differences
    steep = np.einsum("ni,ni->n", slope, slope)
    steep[steep < TILTED**2 * np.trace(both, axis1=1, axis2=2) / 4] = 0.0
    order = np.argsort(-steep, kind="stable")
    first = min(MOST, np.count_nonzero(steep))
    others = np.sort(order[first:])
    kept = np.concatenate([order[:first], others[:: -(-others.size // (2 * MOST - first))]])
    return Differences(*(values[np.sort(kept)] for values in differences))


# ------------------------------------------------------------------ offsets


class Offset(NamedTuple):
    """Offset of a strip from another, east, north, up (m), with its covariance [3, 3] (m²), from so
    many ``groups`` of planes nearby."""

    value: Floats
    covariance: Floats
    groups: int

    @property
    def weight(self) -> Floats:
        """Of the offset in an adjustment, [3, 3]."""
        return np.linalg.inv(self.covariance + np.diag(np.square(SYSTEMATIC_M)))


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
    return Offset(value, inverse @ meat @ inverse, len(groups))


def _adjusted(
    flown: Mapping[StripKey, float],
    names: Mapping[StripKey, str],
    compared: Mapping[tuple[int, int], Offset],
) -> tuple[Strip, ...]:
    """Offsets of strips (most ground first, m²) from the first, by least squares.

    ``compared``: offset of the second strip, by number, from the first. Strips that no chain of
    overlaps ties to the first count from the one with most ground among those that they are tied
    to. Offsets are named where chance explains them too seldom (:data:`FALSE_REMARK` for all strips
    together).
    """
    count = len(flown)
    group = list(range(count))  # the first strip that each is tied to
    for _ in range(count):
        for a, b in compared:
            group[a] = group[b] = min(group[a], group[b])
    normal, right = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    own = [slice(3 * k, 3 * k + 3) for k in range(count)]
    for (a, b), offset in compared.items():
        for one, sign in ((a, -1.0), (b, 1.0)):
            right[own[one]] += sign * offset.weight @ offset.value
            for other, against in ((a, -1.0), (b, 1.0)):
                normal[own[one], own[other]] += sign * against * offset.weight
    is_tied = np.array([group[k] != k for k in range(count)], bool)
    free = np.repeat(is_tied, 3)
    value, covariance = np.zeros(3 * count), np.zeros((3 * count, 3 * count))
    if free.any():
        inverse = np.linalg.inv(normal[np.ix_(free, free)])
        value[free] = inverse @ right[free]
        misfit, redundancy = 0.0, 3 * len(compared) - int(free.sum())
        for (a, b), offset in compared.items():
            rest = offset.value - value[own[b]] + value[own[a]]
            misfit += float(rest @ offset.weight @ rest)
        covariance[np.ix_(free, free)] = inverse * max(misfit / max(redundancy, 1), 1.0)
    tests, keys, strips = max(int(is_tied.sum()), 1), list(flown), []
    for k, (key, ground_m2) in enumerate(flown.items()):
        of, own_covariance, chance = value[own[k]], covariance[own[k], own[k]], 1.0
        if is_tied[k]:
            statistic = of @ np.linalg.solve(own_covariance, of)
            fewest = min(offset.groups for pair, offset in compared.items() if k in pair)
            chance = min(1.0, float(fdtrc(3, fewest - 3, statistic / 3)) * tests)
        others = group[:k] + group[k + 1 :]
        strips.append(
            Strip(
                names[key],
                key,
                ground_m2,
                names[keys[group[k]]] if is_tied[k] or k in others else "",
                tuple(of.round(4).tolist()),
                tuple(map(tuple, own_covariance.round(10).tolist())),
                0.0 if math.isnan(chance) else float(f"{chance:.3g}"),
                bool(is_tied[k] and chance < FALSE_REMARK),
            )
        )
    return tuple(strips)
