"""The dataset of a benchmark with two methods of known errors."""

from __future__ import annotations

import csv
from pathlib import Path

from stereobench.scores.score_method import ScoringPlan

SHAPE = (24, 32)
CITIES = {"KM": "train", "WH": "test"}  # Kunming has training tiles, Wuhan none


PLAN = ScoringPlan(thresholds_px=[3, 1], bootstrap=50, seed=1, panels=2)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def texts(shown) -> list[list[str]]:
    """The lines of a table to read."""
    return [[cell.text for cell in row] for _, lines in shown.groups for row in lines]


def titles(shown) -> list[str]:
    """The headings of its columns."""
    return [column.title for column in shown.columns]
