"""How much two methods differ on the same tiles: pair by pair, with the runs of each as blocks.

Tiles differ more than methods do, so that intervals of single methods overlap even where one is
better on nearly every tile. Compared are means over all pixels (or points) of the tiles that all
runs have. The variance of a difference has two parts, both by what was seen and neither drawn:

*Tiles.* With u the share of a tile in the mean of a run (its sum of errors less its count times the
mean, over all counts), the part is T / (T − 1) times the sum over T tiles of the squares of the
difference of u: what is hard in a tile for both methods cancels.

*Runs.* Trainings with other seeds. A method's mean of r runs has the variance of its runs over r.
Of one run the part is not known and counts as 0: then the interval holds for these weights alone.

The interval is Student's, with the degrees of freedom of Welch and Satterthwaite. It holds
``CONFIDENCE``, so that a table of ten differences between equals has one that is told apart in ten
tables. Sums are those of :func:`math.fsum`, which no order of adding changes.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import fsum, sqrt
from pathlib import Path
from typing import Any

from scipy.special import stdtrit

from stereotruth.core.errors import InputError, in_number
from stereotruth.core.products.files import read_table
from stereotruth.pages.tables import minus

from .scores import MIN_TILES
from .tables import FILLED, Figure, Row, Table, of_figures

CONFIDENCE = 0.99
Sums = Mapping[str, tuple[float, float]]  # by tile: count, sum of errors


@dataclass(frozen=True)
class Difference:
    """Second less first; ``low``, ``high``: the interval, None of fewer than ``MIN_TILES`` tiles.

    ``better_share``: of the tiles on which the second has the smaller mean.
    """

    tiles: int
    value: float | None
    low: float | None
    high: float | None
    better_share: float | None

    @property
    def level(self) -> bool:
        """Whether the two are not told apart."""
        return self.low is None or self.high is None or self.low <= 0 <= self.high

    @property
    def said(self) -> str:
        """What is known of the second."""
        if self.low is None:
            return "too few tiles to tell"
        return "level" if self.level else "better" if self.value < 0 else "worse"

    def row(self, name: str) -> dict[str, float | None]:
        """For a table, by names that begin with that of the figure."""
        ends = {f"{name}_{end}": getattr(self, end) for end in ("low", "high", "better_share")}
        return {name: self.value, **ends}


def difference(first: Sequence[Sums], second: Sequence[Sums]) -> Difference:
    """Mean of the runs of a second method less that of a first one; without first: that mean."""
    runs = [*first, *second]
    tiles = [name for name in runs[0] if all(name in of and of[name][0] > 0 for of in runs)]
    if not tiles:
        return Difference(0, None, None, None, None)
    means, parts = zip(*(_shares(of, tiles) for of in runs))
    sides = [
        (sign, range(begin, end))
        for sign, begin, end in ((-1, 0, len(first)), (1, len(first), len(runs)))
        if end > begin
    ]

    def second_less_first(of: Sequence[float]) -> float:
        """Of a value of each run: the mean of the second's runs less that of the first's."""
        return fsum(sign * fsum(of[r] for r in side) / len(side) for sign, side in sides)

    n, value = len(tiles), second_less_first(means)
    shares = [second_less_first([part[t] for part in parts]) for t in range(n)]
    by_tile = [second_less_first([of[name][1] / of[name][0] for of in runs]) for name in tiles]
    better = round(sum(of < 0 for of in by_tile) / n, 6)
    if n < MIN_TILES:
        return Difference(n, round(value, 6), None, None, better)
    terms = [(n / (n - 1) * fsum(u * u for u in shares), n - 1)]
    for _, side in sides:
        if (count := len(side)) > 1:
            mean = fsum(means[r] for r in side) / count
            spread = fsum((means[r] - mean) ** 2 for r in side) / (count - 1)
            terms.append((spread / count, count - 1))
    variance = fsum(v for v, _ in terms)
    reach = 0.0
    if variance > 0:
        freedom = variance**2 / fsum(v * v / k for v, k in terms)
        reach = float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * sqrt(variance)
    return Difference(
        n, *(round(v, 6) + 0.0 for v in (value, value - reach, value + reach)), better
    )


def _shares(of: Sums, tiles: Sequence[str]) -> tuple[float, list[float]]:
    """A run's mean over tiles, and the share of each in it."""
    count = fsum(of[name][0] for name in tiles)
    mean = fsum(of[name][1] for name in tiles) / count
    return mean, [(of[name][1] - of[name][0] * mean) / count for name in tiles]


# ------------------------------------------------------------------------ folders of scores


def read_sums(folder: str | Path, columns: Mapping[str, tuple[str, str]]) -> dict[str, Sums]:
    """Sums by tile of a folder of scores; ``columns``: count and mean by the name of a figure.

    Raises InputError if the folder has no table of tiles, or not these columns.
    """
    file = next(
        filter(Path.is_file, (Path(folder) / f"{k}.csv" for k in ("scores", "tiles"))), None
    )
    if file is None:
        raise InputError(
            "no scores by tile", file=folder, remedy="name a folder of benchmark/ or of score-dsm"
        )
    try:
        rows = list(read_table(file))
        found: dict[str, Sums] = {
            figure: {
                row["tile"]: (int(row[count]), int(row[count]) * float(row[mean]))
                for row in rows
                if int(row[count])
            }
            for figure, (count, mean) in columns.items()
        }
    except (KeyError, ValueError, csv.Error) as error:
        raise InputError(
            f"no table of scores by tile ({error})", file=file, remedy="score again"
        ) from None
    return found


def _columns_of(folder: str | Path) -> dict[str, tuple[str, str]]:
    """The figures that a folder of scores has by tile."""
    if Path(folder, "tiles.csv").is_file():
        return {
            "height off steps, m": ("points", "mean_absolute_m"),
            "edges, m": ("edges", "position_error_m"),
            "resolution of edges, m": ("edges", "resolution_m"),
        }
    scores = Path(folder, "scores.csv")
    names = next(read_table(scores), {}) if scores.is_file() else {}
    d1 = [name for name in names if name.startswith("filled_d1_")]
    return {"EPE, px": ("labelled", "filled_epe_px"), **{n: ("labelled", n) for n in d1}}


def compare_folders(first: Sequence[Path], second: Sequence[Path]) -> list[str]:
    """A line for each figure of two methods or surface models; the folders of each are its runs."""
    columns = _columns_of(first[0])
    sides = [[read_sums(folder, columns) for folder in of] for of in (first, second)]
    lines = []
    for figure in columns:
        found = difference(*([run[figure] for run in of] for of in sides))
        if found.value is None:
            raise InputError(
                f"{figure}: no tile in common", file=second[0], remedy="score on the same tiles"
            )
        numbers = [found.value, *([] if found.low is None else [found.low, found.high])]
        value, *ends = (minus(f"{v:+.4f}") for v in numbers)
        reach = f" [{', '.join(ends)}]" if ends else ""
        lines.append(f"{figure}: {found.said}, {value}{reach}, {in_number(found.tiles, 'tile')}")
    return lines


def differences(methods: Sequence[Row], folders: Sequence[Sequence[str | Path]]) -> Table:
    """How much methods differ two by two on the same tiles.

    ``folders``: of the runs of each method, with ``scores.csv``.
    """
    title = "Differences: method by method on the same tiles"
    if len(methods) < 2:
        return Table("differences", title, [], [("One method alone.", None)])
    limit = methods[0]["thresholds_px"][0]
    names = {"epe_px": "filled_epe_px", "d1_share": f"filled_d1_{limit:g}_px_share"}
    columns = {key: ("labelled", name) for key, name in names.items()}
    sums = [[read_sums(folder, columns) for folder in runs] for runs in folders]
    rows, told = [], []
    for a, b in combinations(range(len(methods)), 2):
        row: dict[str, Any] = {"method": methods[b]["label"], "less": methods[a]["label"]}
        said = ""
        for key in names:
            found = difference(*([run[key] for run in sums[k]] for k in (a, b)))
            row |= {"tiles": found.tiles, **found.row(key)}
            row.setdefault("level", found.level)  # in EPE
            said = said or found.said
        rows.append(row)
        told.append({**row, "name": f"{row['method']} minus {row['less']}", "said": said})
    better = "better on (% of tiles)"
    figures = [
        Figure("EPE (px)", "epe_px", 1, "+.3f", interval=True),
        Figure(better, "epe_px_better_share", 100, ".0f"),
        Figure(f"D1, {limit:g} px (%)", "d1_share", 100, "+.2f", interval=True),
        Figure(better, "d1_share_better_share", 100, ".0f"),
    ]
    caption = (
        f"Difference of {FILLED}, with {CONFIDENCE:.0%} confidence from the differences by tile: "
        "negative where the first of the two is better, level where the interval holds 0. Fewer "
        f"than {MIN_TILES} tiles have no interval and tell nothing apart."
    )
    shown = of_figures(told, {"name": "Methods"}, figures, {"said": "in EPE"})
    return Table("differences", title, rows, [(caption, shown)])
