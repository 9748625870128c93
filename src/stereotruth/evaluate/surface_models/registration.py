"""How a surface model is moved against its reference: a shift in three dimensions, and a tilt.

Where there are roofs, their edges tell the shift in the plane: the model has each edge displaced by
the shift along the edge's normal, and by how much it draws all roofs too wide (:mod:`.edges`).
Where there are few, the shift is the one at which the heights agree best, as in the method of
Nuth & Kääb (2011, The Cryosphere 5, 271–290, doi:10.5194/tc-5-271-2011), with a robust sum of the
differences instead of their regression on slope and aspect. That also finds the shift at first.
Standard uncertainties are those of the delete-a-group jackknife (Kott 2001, Journal of Official
Statistics 17, 521–526) over parts of the scene, which knows of errors that are alike nearby.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ...core.numerics.statistics import huber_weights, median_and_nmad, reweighted_fit
from ...lidar.height_raster import Floats, Window
from .edges import Edges, measure

SEARCH_M = 24.0  # shifts looked for, to each side
COARSE = (4.0, 2.0, 1.0, 0.5)  # m, steps of the search
FARTHEST_M = 3.0  # a difference beyond counts as one of this: another surface
LEAST_EDGES = 60  # that tell a shift, with a tenth of them across any direction
ROUNDS = 3  # of edges measured and the shift taken out
GROUPS = 16
LEAST_GROUPS = 4
LEAST_SCALE_M = 0.05
FEW, MANY = 10_000, 120_000  # places of the search and of the fit


@dataclass(frozen=True)
class Registration:
    """The model's displacement against the reference, m, and its standard uncertainties.

    What lies at (x, y, z) in the reference lies at (x + east, y + north, z + up) in the model.
    East and north are those of the ellipsoid in the model's middle, whatever its grid.
    ``tilt_*``: what is left of the difference of heights along east and north, m per km. The
    uncertainties are None where the ground is too small for them. ``edges``: that told east and
    north, 0 if the heights did.
    """

    east_m: float
    north_m: float
    up_m: float
    sigma_east_m: float | None
    sigma_north_m: float | None
    sigma_up_m: float | None
    tilt_east_m_per_km: float
    tilt_north_m_per_km: float
    sigma_tilt_east_m_per_km: float | None
    sigma_tilt_north_m_per_km: float | None
    places: int
    edges: int

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready."""
        values = asdict(self).items()
        return {name: None if value is None else round(value, 4) for name, value in values}


@dataclass(frozen=True)
class Part:
    """Reference points [n] (m) and edges in one window of the model."""

    window: Window
    x: Floats
    y: Floats
    z: Floats
    edges: Edges

    def difference(self, east: float, north: float) -> Floats:
        """Model less reference, m [n], of a model that is moved so far; NaN unknown."""
        return self.window.at(self.x + east, self.y + north) - self.z


def _cost(differences: Floats, scale: float, *, holes_cost: bool = False) -> float:
    """Mean over places of a function that is quadratic near 0, then linear, and level at last.

    ``holes_cost``: places without a height count as far off, so that a search gains nothing by
    leaving the model; else they do not count.
    """
    size = np.minimum(np.hypot(differences, scale) - scale, FARTHEST_M)
    known = size[np.isfinite(size)]
    if holes_cost:
        return float(known.sum() + (size.size - known.size) * FARTHEST_M) / max(size.size, 1)
    return float(known.mean()) if known.size else FARTHEST_M


def _thinned(parts: Sequence[Part], most: int, seed: int) -> list[Part]:
    total = sum(part.x.size for part in parts)
    share = min(1.0, most / max(total, 1))
    rng = np.random.default_rng(seed)
    chosen = [rng.random(part.x.size) < share for part in parts]
    return [replace(p, x=p.x[c], y=p.y[c], z=p.z[c]) for p, c in zip(parts, chosen)]


def _differences(parts: Sequence[Part], east: float, north: float) -> Floats:
    return np.concatenate([part.difference(east, north) for part in parts])


def _search(parts: Sequence[Part]) -> tuple[float, float, float]:
    """The shift to half a metre, from coarse steps to fine."""
    best = (np.inf, 0.0, 0.0, 0.0)
    centre, reach = (0.0, 0.0), SEARCH_M
    for step in COARSE:
        offsets = np.arange(-reach, reach + step / 2, step)
        for east in centre[0] + offsets:
            for north in centre[1] + offsets:
                d = _differences(parts, east, north)
                if not np.isfinite(d).any():
                    continue
                up = float(np.nanmedian(d))
                cost = _cost(d - up, LEAST_SCALE_M, holes_cost=True)
                best = min(best, (cost, float(east), float(north), up))
        centre, reach = best[1:3], step
    return best[1:]


def _fit(parts: Sequence[Part], start: Sequence[float], scale: float, size: float) -> Floats:
    """The shift (east, north, up) of least cost, from nearby."""
    start = np.asarray(start, dtype=np.float64)
    found = minimize(
        lambda shift: _cost(_differences(parts, *shift[:2]) - shift[2], scale),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + size * np.vstack([np.zeros(3), np.eye(3)]),
            "xatol": 5e-4,
            "fatol": 1e-9,
            "maxfev": 200,
        },
    )
    return found.x


def _tilt(parts: Sequence[Part], shift: Floats) -> Floats:
    """Slope of what is left along east and north, m per m."""
    x, y = (np.concatenate([getattr(p, n) for p in parts]) for n in "xy")
    d = _differences(parts, *shift[:2]) - shift[2]
    known = np.abs(d) < FARTHEST_M
    x, y, d = x[known], y[known], d[known]
    reach = max(np.ptp(x), np.ptp(y), 1.0) if x.size else 1.0
    columns = np.column_stack([np.ones(x.size), (x - x.mean()) / reach, (y - y.mean()) / reach])
    return _huber(columns, d)[1:] / reach


def _huber(columns: Floats, values: Floats) -> Floats:
    """Coefficients of a linear fit with Huber's weights, least scale LEAST_SCALE_M."""
    return reweighted_fit(columns, values, huber_weights, least_sigma=LEAST_SCALE_M)


@dataclass(frozen=True)
class _Displaced:
    """Edges [n] as a model has them: normals, outward displacement (m), group."""

    normals: Floats
    outward: Floats
    group: NDArray[np.int64]

    @classmethod
    def of(cls, parts: Sequence[Part], groups: Sequence[int], shift: Floats) -> _Displaced:
        """Measured in a model that is moved by ``shift``."""
        normals, outward, group = [np.empty((0, 2))], [np.empty(0)], [np.empty(0, np.int64)]
        for part, number in zip(parts, groups):
            if not part.edges.x.size:
                continue

            def height_at(x: Floats, y: Floats, window: Window = part.window) -> Floats:
                return window.at(x + shift[0], y + shift[1]) - shift[2]

            seen = measure(part.edges, height_at, bridge=False)
            normals.append(np.column_stack([part.edges.nx, part.edges.ny])[seen.found])
            outward.append(seen.outward[seen.found])
            group.append(np.full(int(seen.found.sum()), number))
        return cls(np.concatenate(normals), np.concatenate(outward), np.concatenate(group))

    @property
    def enough(self) -> bool:
        """Whether they tell a shift in every direction."""
        n = len(self.outward)
        least = np.linalg.eigvalsh(self.normals.T @ self.normals)[0] if n else 0.0
        return n >= LEAST_EDGES and least >= 0.1 * n

    def shift(self, without: int | None = None) -> Floats:
        """(east, north) that is left, m; roofs may all be too wide by one length."""
        of = self.group != without
        columns = np.column_stack([self.normals[of], np.ones(int(of.sum()))])
        return _huber(columns, self.outward[of])[:2]


def _up(parts: Sequence[Part], shift: Floats) -> float:
    """The height by which most places differ, m."""
    d = _differences(parts, *shift[:2]) - shift[2]
    d = d[np.abs(d) < FARTHEST_M]
    return float(shift[2] + _huber(np.ones((d.size, 1)), d)[0]) if d.size else float(shift[2])


def _to_enu(shift: Floats, to_enu: Floats) -> Floats:
    return np.array([*(to_enu @ shift[:2]), shift[2]])


def register(
    parts: Sequence[Part], groups: Sequence[int], to_enu: Floats, seed: int = 0
) -> Registration | None:
    """The registration over all parts; ``groups``: the jackknife's group of each, 0 to GROUPS − 1.

    ``to_enu`` [2, 2] takes vectors of the parts' places to metres east and north. None if fewer
    than 100 places have a height.
    """
    few = _thinned(parts, FEW, seed)
    shift = np.array(_search(few))
    d = _differences(few, *shift[:2]) - shift[2]
    if np.isfinite(d).sum() < 100:
        return None
    scale = max(median_and_nmad(d[np.isfinite(d)])[1], LEAST_SCALE_M)
    many = _thinned(parts, MANY, seed + 1)
    shift = _fit(few, shift, scale, 0.4)
    shift[2] = _up(few, shift)
    edges = _Displaced.of(parts, groups, shift)
    by_edges = edges.enough
    for _ in range(ROUNDS if by_edges else 0):
        shift[:2] += edges.shift()
        shift[2] = _up(few, shift)
        edges = _Displaced.of(parts, groups, shift)
    if not by_edges:
        shift = _fit(many, shift, scale, 0.1)
    of_slopes = np.linalg.inv(to_enu)
    again = []
    for group in sorted(set(groups)):
        rest = [part for part, of in zip(many, groups) if of != group]
        if by_edges:
            moved = np.array([*(shift[:2] + edges.shift(without=group)), shift[2]])
        else:
            moved = _fit(rest, shift, scale, 0.05)
        moved[2] = _up(rest, moved)
        again.append([*_to_enu(moved, to_enu), *_tilt(rest, moved) @ of_slopes])
    shift[2] = _up(many, shift)
    tilt = _tilt(many, shift) @ of_slopes
    spread = np.array(again) - np.mean(again, axis=0)
    n = len(again)
    sigma: list[float | None] = [None] * 5
    if n >= LEAST_GROUPS:
        variance = (n - 1) / n * (spread**2).sum(axis=0)
        sigma = list(map(float, np.sqrt(variance) * [1, 1, 1, 1000, 1000]))
    return Registration(
        *map(float, _to_enu(shift, to_enu)),
        *sigma[:3],
        *map(float, 1000 * tilt),
        *sigma[3:],
        places=sum(part.x.size for part in many),
        edges=len(edges.outward) if by_edges else 0,
    )
