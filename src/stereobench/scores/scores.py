"""Scores of a method's disparities: EPE and D1 as in the paper (section V), and where they arise.

Counted are the labelled pixels whose label lies in the disparity range, pooled over the pixels of
all tiles. EPE is the mean absolute error, D1 the share of pixels with an error above a threshold.
A method that leaves pixels invalid is scored twice: on the pixels that it says to be valid, and
with its holes filled (:func:`fill_holes`); for a method without holes the two agree. Confidence
intervals (95 %) come from resampling tiles, since pixels of one tile are not independent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.numerics.arrays import Bools, Floats
from stereotruth.core.products.rasters import OFTEN

Disparity = NDArray[np.float32]  # [h, w] px, NaN: none

ALL = "all"
MIN_TILES = 5
CONFIDENCE = (2.5, 97.5)  # percent

LIMITS_PX = (*np.arange(5, 100, 5) / 100, *np.arange(10, 50) / 10, *np.arange(10, 41) / 2)

TURNED = 0.5  # EPE of −d to that of d, below which the sign is in doubt
OUTSIDE_SHARE = 0.01  # of the values
ONE_VALUE_SHARE = 0.5  # of the values outside the range, that are one and the same


@dataclass
class Scores:
    """Sums by tile and stratum.

    Quantities of a sum: labelled, valid; of the valid ones the sum of absolute errors and the
    number above each threshold; the same of the labelled ones with holes filled.
    """

    thresholds_px: Sequence[float]
    tiles: list[tuple[str, str, Mapping[str, Floats]]] = field(default_factory=list)

    def add(self, tile: str, city: str, sums: Mapping[str, Floats]) -> None:
        """Add a tile's sums by stratum, whatever strata it has."""
        self.tiles.append((tile, city, sums))

    @property
    def strata(self) -> list[str]:
        """Those of all tiles, in their order of appearance."""
        return list(dict.fromkeys(name for _, _, sums in self.tiles for name in sums))

    def figures(self, total: Floats) -> dict[str, float | None]:
        """Figures of pooled sums: counts, shares 0 … 1, px; None where there is no pixel."""
        labelled, valid, *rest = total.tolist()
        half = len(rest) // 2

        def part(values: Sequence[float], count: float) -> list[float | None]:
            return [round(value / count, 6) if count else None for value in values]

        names = ["epe_px", *(f"d1_{limit:g}_px_share" for limit in self.thresholds_px)]
        return {
            "labelled": int(labelled),
            "valid_share": part([valid], labelled)[0],
            **dict(zip(names, part(rest[:half], valid))),
            **dict(zip((f"filled_{name}" for name in names), part(rest[half:], labelled))),
        }

    def _labelled(self, city: str | None, stratum: str) -> Floats:
        """Sums [tile, quantity] of the tiles of a city (None: all) with labels in a stratum."""
        chosen = [
            sums[stratum]
            for _, of, sums in self.tiles
            if city in (None, of) and stratum in sums and sums[stratum][0] > 0
        ]
        return np.array(chosen).reshape(len(chosen), 4 + 2 * len(self.thresholds_px))

    def row(self, city: str | None = None, stratum: str = ALL) -> dict[str, float | None]:
        """Figures pooled over the tiles of a city (None: all)."""
        return self.figures(self._labelled(city, stratum).sum(axis=0))

    def intervals(
        self, times: int, seed: int, city: str | None = None, stratum: str = ALL
    ) -> dict[str, tuple[float, float] | None]:
        """95 % confidence intervals of the figures of :meth:`row`, by resampling its tiles.

        None of fewer than ``MIN_TILES`` tiles, which would not show how much tiles differ.
        """
        sums = self._labelled(city, stratum)
        if self.no_interval(times, city, stratum):
            return dict.fromkeys(
                name for name in self.figures(sums.sum(axis=0)) if name != "labelled"
            )
        samples = [self.figures(total) for total in resampled(sums, times, seed)]
        found = {}
        for name in samples[0]:
            values = [sample[name] for sample in samples if sample[name] is not None]
            if name != "labelled":
                low, high = np.percentile(values, CONFIDENCE) if values else (np.nan, np.nan)
                found[name] = (round(float(low), 6), round(float(high), 6)) if values else None
        return found

    def no_interval(self, times: int, city: str | None = None, stratum: str = ALL) -> str | None:
        """Why :meth:`intervals` has none; None where it has them."""
        if not times:
            return "benchmark.bootstrap is 0"
        count = len(self._labelled(city, stratum))
        if count < MIN_TILES:
            return f"{count} tiles have such labels, and resampling needs {MIN_TILES}"
        return None


def resampled(sums: Floats, times: int, seed: int) -> Floats:
    """Totals [times, quantity] of sums [tile, quantity], tiles drawn with replacement."""
    count = len(sums)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), times)
    return drawn @ sums


@dataclass(frozen=True)
class Scorer:
    """Scores predictions of one dataset.

    ``disparity_range``: px, first inclusive, second exclusive; ``grows_with_height``: see
    :func:`fill_holes`.
    """

    disparity_range: tuple[int, int]
    thresholds_px: Sequence[float] = (3.0, 1.0)
    grows_with_height: bool = True

    def counted(self, truth: NDArray[Any]) -> Bools:
        """The pixels that count: labelled, in the range."""
        low, high = self.disparity_range
        with np.errstate(invalid="ignore"):
            return (truth >= low) & (truth < high)

    def filled(self, disparity: Disparity) -> Disparity:
        """A prediction without holes."""
        middle = sum(self.disparity_range) / 2
        return fill_holes(disparity, middle, grows_with_height=self.grows_with_height)

    def sums(
        self, disparity: Disparity, truth: Disparity, strata: Mapping[str, Bools] | None = None
    ) -> dict[str, Floats]:
        """Quantities (see :class:`Scores`) of a tile over all counted pixels and by stratum."""
        counted = self.counted(truth)
        label = truth[counted].astype(np.float64)
        error = np.abs(disparity[counted] - label)
        valid = np.isfinite(error)
        filled = error if valid.all() else np.abs(self.filled(disparity)[counted] - label)

        def errors(of: Floats) -> list[float]:
            total = np.cumsum(of)[-1] if of.size else 0.0  # added in one order on any machine
            return [float(total), *(int((of > limit).sum()) for limit in self.thresholds_px)]

        chosen = {ALL: np.ones(label.size, bool)}
        chosen |= {name: of[counted] for name, of in (strata or {}).items()}
        return {
            name: np.array(
                [
                    np.count_nonzero(here),
                    np.count_nonzero(valid & here),
                    *errors(error[valid & here]),
                    *errors(filled[here]),
                ],
                dtype=np.float64,
            )
            for name, here in chosen.items()
        }


def fill_holes(
    disparity: Disparity, default: float = 0.0, *, grows_with_height: bool = True
) -> Disparity:
    """A disparity map without NaN, so that methods with and without holes compare.

    As in the KITTI benchmark's development kit: along each row, an invalid pixel takes the
    disparity of the nearest valid pixels on its two sides, of two that of the one further down,
    since most invalid pixels are hidden behind what is higher. Rows without a valid pixel take
    those of the nearest row that has one, of two the upper. ``grows_with_height``: whether of two
    disparities the larger is the higher one; ``default``: the value of a map that has none.
    """
    rows = np.flatnonzero(np.isfinite(disparity).any(axis=1))
    if not rows.size:
        return np.full_like(disparity, default)
    before, after = _along_rows(disparity), _along_rows(disparity[:, ::-1])[:, ::-1]
    lower = np.fmin if grows_with_height else np.fmax  # these pass NaN over
    away = np.abs(rows - np.arange(len(disparity))[:, None])
    return lower(before, after)[rows[np.argmin(away, axis=1)]]


def _along_rows(disparity: Disparity) -> Disparity:
    """The last valid disparity up to each pixel of a row; NaN before the first."""
    column = np.arange(disparity.shape[1])
    last = np.maximum.accumulate(np.where(np.isfinite(disparity), column, 0), axis=1)
    return np.take_along_axis(disparity, last, axis=1)


class Cumulative:
    """Counts of absolute errors in px, to which tiles are added: pixels below many limits.

    Counted are the pixels of the tables, all labelled ones with holes filled: at a threshold of D1
    the share is one less D1.
    """

    def __init__(self, thresholds_px: Sequence[float] = ()) -> None:
        self.limits = np.unique(np.round([*LIMITS_PX, *thresholds_px], 6))
        self._counts = np.zeros(self.limits.size + 1, np.int64)

    def add(self, error: NDArray[np.floating[Any]]) -> None:
        """Count absolute errors (px, all finite)."""
        place = np.searchsorted(self.limits, np.asarray(error).ravel(), side="left")
        self._counts += np.bincount(place, minlength=self._counts.size)

    def rows(self) -> list[dict[str, float]]:
        """Rows of ``cumulative.csv``: limit, share of the pixels whose error is not above it."""
        shares = np.cumsum(self._counts)[:-1] / max(int(self._counts.sum()), 1)
        return [
            {"error_px": float(limit), "share": round(float(share), 6)}
            for limit, share in zip(self.limits, shares)
        ]


@dataclass
class Doubts:
    """What makes results doubtful before their scores are read: sign, nodata, range [px, px)."""

    disparity_range: tuple[int, int]
    scored: int = 0
    error_px: float = 0.0
    turned_error_px: float = 0.0
    values: int = 0
    outside: int = 0
    repeated: Counter[float] = field(default_factory=Counter)
    zeros: int = 0
    near_zero: int = 0  # within a px, and not zero
    least: float = np.inf
    most: float = -np.inf

    def add(self, disparity: Disparity, truth: NDArray[Any]) -> None:
        """Add a pair: disparity and truth [h, w] px, NaN where there is none."""
        both = np.isfinite(disparity) & np.isfinite(truth)
        found, exact = disparity[both].astype(np.float64), truth[both].astype(np.float64)
        self.scored += found.size
        self.error_px += float(np.abs(found - exact).sum())
        self.turned_error_px += float(np.abs(-found - exact).sum())
        values = disparity[np.isfinite(disparity)]
        if values.size:
            self.least = min(self.least, float(values.min()))
            self.most = max(self.most, float(values.max()))
        low, high = self.disparity_range
        outside = values[(values < low) | (values >= high)]
        self.values += values.size
        self.zeros += int((values == 0).sum())
        self.near_zero += int(((values != 0) & (np.abs(values) <= 1.0)).sum())
        self.outside += outside.size
        if outside.size:
            each, count = np.unique(outside, return_counts=True)
            self.repeated[float(each[count.argmax()])] += int(count.max())

    @property
    def constant_px(self) -> float | None:
        """The one disparity that a method returns everywhere; None of more than one."""
        return self.least if self.least == self.most else None

    def lines(self) -> list[str]:
        """A sentence for each doubt."""
        found = []
        if self.constant_px is not None:
            found.append(f"returns the constant {self.constant_px:g} px everywhere")
        if self.turned_error_px < TURNED * self.error_px:
            turned, epe = self.turned_error_px / self.scored, self.error_px / self.scored
            found.append(f"−d would score {turned:.3g} px, d scores {epe:.3g}: is the sign turned?")
        if self.outside > OUTSIDE_SHARE * self.values:
            low, high = self.disparity_range
            where = f"outside [{low}, {high}) px".replace("-", "−")
            value, count = self.repeated.most_common(1)[0]
            if count > ONE_VALUE_SHARE * self.outside:
                found.append(
                    f"{100 * count / self.values:.2g} % of the values are {value:g}, {where}: "
                    "is that nodata? Write NaN for it, or declare it as the dataset's nodata"
                )
            else:
                share = 100 * self.outside / self.values
                found.append(f"{share:.2g} % of the values lie {where}")
        if self.zeros > max(OUTSIDE_SHARE * self.values, OFTEN * self.near_zero):
            found.append(
                f"{100 * self.zeros / self.values:.2g} % of the values are exactly 0, and hardly "
                "any is near it: is that nodata? Write NaN for it"
            )
        return found
