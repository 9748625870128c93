"""Scores of a method's disparities: EPE and D1 as in the paper (section V), and where they arise.

Counted are the labelled pixels whose label lies in the disparity range, pooled over the pixels of
all tiles. EPE is the mean absolute error, D1 the share of pixels with an error above a threshold.
A method that leaves pixels invalid is scored twice: on the pixels that it says to be valid, and
with its holes filled (:mod:`.holes`); for a method without holes the two agree. Confidence
intervals (95 %) come from resampling tiles, since pixels of one tile are not independent.

Sums are kept by tile and stratum, in one array, and everything else is made of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .holes import fill_holes

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


ALL = "all"
MIN_TILES = 5
CONFIDENCE = (2.5, 97.5)  # percent


@dataclass
class Scores:
    """Sums by tile and stratum, ``sums`` float64[tile, stratum, quantity].

    Quantities: labelled, valid; of the valid ones the sum of absolute errors and the number above
    each threshold; the same of the labelled ones with holes filled.
    """

    tiles: list[str]
    cities: list[str]
    strata: list[str]
    thresholds_px: tuple[float, ...]
    sums: Floats

    def row(self, where: Bools | None = None, stratum: str = ALL) -> dict[str, float | None]:
        """Figures pooled over the chosen tiles."""
        sums = self.sums[:, self.strata.index(stratum)]
        return self._figures((sums if where is None else sums[where]).sum(axis=0))

    def in_city(self, city: str) -> Bools:
        """The tiles of a city."""
        return np.array([name == city for name in self.cities])

    def _figures(self, sums: Floats) -> dict[str, float | None]:
        """Figures of pooled sums: counts, shares 0 … 1, px; None where there is no pixel."""
        labelled, valid, *rest = sums.tolist()
        half = len(rest) // 2

        def part(values: Sequence[float], count: float) -> list[float | None]:
            return [round(value / count, 6) if count else None for value in values]

        names = ["epe_px", *(f"d1_{limit:g}_px_share" for limit in self.thresholds_px)]
        values = [*part(rest[:half], valid), *part(rest[half:], labelled)]
        return {
            "labelled": int(labelled),
            "valid_share": part([valid], labelled)[0],
            **dict(zip(_both(names), values)),
        }

    def intervals(
        self, times: int, seed: int, where: Bools | None = None, stratum: str = ALL
    ) -> dict[str, tuple[float, float] | None]:
        """95 % confidence intervals of the figures of :meth:`row`, by resampling its tiles.

        None of fewer than ``MIN_TILES`` tiles, which would not show how much tiles differ.
        """
        sums = self._with_labels(where, stratum)
        if self.no_interval(times, where, stratum):
            return dict.fromkeys(
                name for name in self._figures(self.sums[0, 0]) if name != "labelled"
            )
        samples = [self._figures(total) for total in resampled(sums, times, seed)]
        found = {}
        for name in samples[0]:
            values = [sample[name] for sample in samples if sample[name] is not None]
            if name != "labelled":
                low, high = np.percentile(values, CONFIDENCE) if values else (np.nan, np.nan)
                found[name] = (round(float(low), 6), round(float(high), 6)) if values else None
        return found

    def no_interval(self, times: int, where: Bools | None = None, stratum: str = ALL) -> str | None:
        """Why :meth:`intervals` has none; None where it has them."""
        if not times:
            return "benchmark.bootstrap is 0"
        count = len(self._with_labels(where, stratum))
        if count < MIN_TILES:
            return f"{count} tiles have such labels, and resampling needs {MIN_TILES}"
        return None

    def _with_labels(self, where: Bools | None, stratum: str) -> Floats:
        """Sums [tile, quantity] of the chosen tiles that have labels in the stratum."""
        sums = self.sums[:, self.strata.index(stratum)]
        sums = sums if where is None else sums[where]
        return sums[sums[:, 0] > 0]


def resampled(sums: Floats, times: int, seed: int) -> Floats:
    """Totals [times, quantity] of sums [tile, quantity], tiles drawn with replacement."""
    count = len(sums)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), times)
    return drawn @ sums


def _both(names: Sequence[str]) -> list[str]:
    return [*names, *(f"filled_{name}" for name in names)]


@dataclass(frozen=True)
class Scorer:
    """Scores predictions of one dataset.

    ``disparity_range``: px, first inclusive, second exclusive; ``grows_with_height``: see
    :func:`.holes.fill_holes`.
    """

    disparity_range: tuple[int, int]
    thresholds_px: Sequence[float] = (3.0, 1.0)
    grows_with_height: bool = True

    def counted(self, truth: NDArray[Any]) -> Bools:
        """The pixels that count: labelled, in the range."""
        low, high = self.disparity_range
        with np.errstate(invalid="ignore"):
            return (truth >= low) & (truth < high)

    def filled(self, disparity: NDArray[np.float32]) -> NDArray[np.float32]:
        """A prediction without holes."""
        middle = sum(self.disparity_range) / 2
        return fill_holes(disparity, middle, grows_with_height=self.grows_with_height)

    def sums(
        self,
        disparity: NDArray[np.float32],
        truth: NDArray[np.float32],
        strata: Mapping[str, Bools] | None = None,
    ) -> dict[str, Floats]:
        """Quantities (see :class:`Scores`) of a tile over all counted pixels and by stratum."""
        counted = self.counted(truth)
        chosen = {ALL: None} | {name: of[counted] for name, of in (strata or {}).items()}
        label = truth[counted].astype(np.float64)
        error = np.abs(disparity[counted] - label)
        valid = np.isfinite(error)
        error_filled = error if valid.all() else np.abs(self.filled(disparity)[counted] - label)
        return {
            name: np.array(
                [
                    valid.size if here is None else np.count_nonzero(here),
                    np.count_nonzero(valid if here is None else valid & here),
                    *self._errors(error[valid if here is None else valid & here]),
                    *self._errors(error_filled if here is None else error_filled[here]),
                ],
                dtype=np.float64,
            )
            for name, here in chosen.items()
        }

    def _errors(self, error: Floats) -> list[float]:
        return [float(error.sum()), *(int((error > limit).sum()) for limit in self.thresholds_px)]


@dataclass
class Collector:
    """Puts the sums of tiles together, whatever strata each has."""

    thresholds_px: Sequence[float]
    tiles: list[tuple[str, str, Mapping[str, Floats]]] = field(default_factory=list)

    def add(self, tile: str, city: str, sums: Mapping[str, Floats]) -> None:
        """Add a tile's sums."""
        self.tiles.append((tile, city, sums))

    def scores(self) -> Scores:
        """All that was added; strata in their order of appearance."""
        strata = list(dict.fromkeys(name for _, _, sums in self.tiles for name in sums))
        width = 4 + 2 * len(self.thresholds_px)
        array = np.zeros((len(self.tiles), len(strata), width))
        for t, (_, _, sums) in enumerate(self.tiles):
            for name, values in sums.items():
                array[t, strata.index(name)] = values
        return Scores(
            [tile for tile, _, _ in self.tiles],
            [city for _, city, _ in self.tiles],
            strata,
            tuple(float(limit) for limit in self.thresholds_px),
            array,
        )
