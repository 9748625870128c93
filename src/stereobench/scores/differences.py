"""Methods of a dataset two by two: how much one is better than the other on the same tiles.

Tiles differ more than methods do, so that intervals of single methods overlap even where one method
is better on nearly every tile. Here both are resampled together (a paired bootstrap over tiles), so
that what is hard in a tile for both cancels. Compared are the figures of the tables: all labelled
pixels, holes filled, pooled.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.products.files import read_table

from .scores import CONFIDENCE, MIN_TILES, resampled
from .tables import FILLED, Table, nothing, plain_table, with_interval

Sums = dict[str, NDArray[np.float64]]  # by tile: labelled pixels, and a figure's sum over them
Row = dict[str, Any]


def read_tiles(folder: str | Path, figures: Sequence[str]) -> dict[str, Sums]:
    """Sums by figure and tile of a method's ``scores.csv``; tiles without labels are left out."""
    rows = [row for row in read_table(Path(folder) / "scores.csv") if int(row["labelled"])]
    return {
        name: {row["tile"]: int(row["labelled"]) * np.array([1, float(row[name])]) for row in rows}
        for name in figures
    }


def difference(first: Sums, second: Sums, times: int, seed: int) -> dict[str, Any]:
    """Second less first over the tiles that both have, and its 95 % interval.

    No interval (None) of fewer than ``MIN_TILES`` tiles; ``better``: the share of tiles on which
    the second method has the smaller figure.
    """
    tiles = [name for name in first if name in second]
    sums = np.array([[*first[name], *second[name]] for name in tiles]).reshape(-1, 4)

    def pooled(total: NDArray[np.float64]) -> NDArray[np.float64]:
        return total[..., 3] / total[..., 2] - total[..., 1] / total[..., 0]

    found: dict[str, Any] = {"tiles": len(tiles), "value": None, "low": None, "high": None}
    found["better"] = float((pooled(sums) < 0).mean()) if tiles else None
    if tiles:
        found["value"] = float(pooled(sums.sum(axis=0)))
    if len(tiles) >= MIN_TILES and times:
        samples = pooled(resampled(sums, times, seed))
        found["low"], found["high"] = np.percentile(samples, CONFIDENCE).tolist()
    return found


def differences(methods: Sequence[Row], folders: Sequence[str | Path], *, seed: int) -> Table:
    """The table of all pairs of methods.

    ``methods``: summaries of one dataset; ``folders``: theirs, with ``scores.csv``; intervals come
    from as many samples as those of the first method.
    """
    title = "Differences: method by method on the same tiles"
    if len(methods) < 2:
        return nothing("differences", title, "One method alone.")
    limit = methods[0]["thresholds_px"][0]
    names = {"epe_px": "filled_epe_px", "d1_share": f"filled_d1_{limit:g}_px_share"}
    tiles = [read_tiles(folder, list(names.values())) for folder in folders]
    rows, lines = [], []
    for a, b in combinations(range(len(methods)), 2):
        found = {
            key: difference(tiles[a][name], tiles[b][name], methods[0]["bootstrap"], seed)
            for key, name in names.items()
        }
        row: Row = {"method": methods[b]["label"], "less": methods[a]["label"]}
        row["tiles"] = found["epe_px"]["tiles"]
        for key, of in found.items():
            row |= {
                key: _rounded(of["value"]),
                f"{key}_low": _rounded(of["low"]),
                f"{key}_high": _rounded(of["high"]),
                f"{key}_better_share": _rounded(of["better"]),
            }
        rows.append(row)
        lines.append(
            [
                f"{row['method']} minus {row['less']}",
                with_interval(row, "epe_px", 1, "+.3f"),
                with_interval(row, "epe_px_better_share", 100, ".0f"),
                with_interval(row, "d1_share", 100, "+.2f"),
                with_interval(row, "d1_share_better_share", 100, ".0f"),
            ]
        )
    heading = ["Methods", "EPE (px)", "better on (% of tiles)", f"D1, {limit:g} px (%)"]
    heading.append(heading[2])
    caption = (
        f"Difference of {FILLED}, with 95 % confidence by resampling the tiles of both methods "
        "together: negative where the first of the two is better."
    )
    return Table("differences", title, rows, [(caption, plain_table(heading, lines))])


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)
