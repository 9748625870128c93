"""Geometry of the page's line drawings, in the units of their SVG view boxes (y down)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from ..products.pictures import round_length

SIDE = 300.0  # longer side of a frame of residuals
SHARE = 1 / 8  # of the frame, taken by the longest arrow
WIDTH, HEIGHT = 420.0, 150.0  # of a histogram
BARS = 80  # most bars of a histogram


@dataclass(frozen=True)
class Arrow:
    """A residual: from (x, y) by (dx, dy), both in the drawing, with a text to show."""

    x: float
    y: float
    dx: float
    dy: float
    used: bool
    text: str


@dataclass(frozen=True)
class ArrowFrame:
    """One frame of residual vectors; the key is an arrow of ``key_length`` for ``key_px``."""

    title: str
    width: float
    height: float
    arrows: tuple[Arrow, ...]
    key_px: float
    key_length: float


def longest_residual(points: Sequence[Mapping[str, Any]], which: str) -> float:
    """Length in px of the longest residual ``which`` of the GCPs that took part; 0 of none."""
    used = (p[which] for p in points if p.get("used", True) and None not in p.get(which, [None]))
    return max((math.hypot(*pair) for pair in used), default=0.0)


def arrow_frame(
    title: str,
    size: Sequence[float],
    points: Sequence[Mapping[str, Any]],
    which: str,
    longest: float,
) -> ArrowFrame | None:
    """Residuals ``which`` of GCP records (measured, used, id) on an image of (cols, rows).

    A residual of ``longest`` px takes ``SHARE`` of the frame.
    """
    shown = [p for p in points if p.get(which) and None not in (*p[which], *p["measured"])]
    if not shown:
        return None
    longest = max(longest, 1e-3)
    scale = SIDE / max(size)
    arrow = SHARE * SIDE / longest
    arrows = []
    for p in shown:
        col, row = p["measured"]
        dx, dy = p[which]
        length = math.hypot(dx, dy)
        shrink = arrow * min(1.0, 2 * longest / max(length, 1e-9))  # a blunder stays on the page
        text = f"{p['id']}: {length:.2f} px" + (f"; {p['reason']}" if p.get("reason") else "")
        numbers = (round(v, 1) for v in (col * scale, row * scale, dx * shrink, dy * shrink))
        arrows.append(Arrow(*numbers, bool(p.get("used", True)), text))
    key = round_length(longest)
    width, height = (round(scale * n, 1) for n in size)
    return ArrowFrame(title, width, height, tuple(arrows), key, round(key * arrow, 1))


@dataclass(frozen=True)
class Histogram:
    """A histogram's outline as an SVG path, and ticks as (x, text)."""

    title: str
    colour: str
    count: int
    mean: float
    path: str
    ticks: tuple[tuple[float, str], ...]
    peak: float


def histograms(
    counted: Sequence[tuple[str, str, Mapping[int, int]]],
) -> list[Histogram]:
    """Histograms of pixels by whole px, (title, colour, counts) each, on one common axis.

    Columns are joined where there are many; those beyond the permille at either end of all
    counts together are left out of the drawing.
    """
    total: dict[int, int] = {}
    for _, _, counts in counted:
        for value, count in counts.items():
            total[value] = total.get(value, 0) + count
    if not total:
        return []
    values = np.array(sorted(total))
    share = np.cumsum([total[v] for v in values.tolist()]) / sum(total.values())
    low = int(values[np.searchsorted(share, 0.001)])
    high = int(values[min(np.searchsorted(share, 0.999), len(values) - 1)]) + 1
    step = max(1, math.ceil((high - low) / BARS))
    high = low + step * math.ceil((high - low) / step)
    scale = WIDTH / (high - low)
    ticks = [t for t in MaxNLocator(6, integer=True).tick_values(low, high) if low <= t <= high]
    found = []
    for title, colour, counts in counted:
        number = sum(counts.values())
        if not number:
            continue
        bars = np.zeros((high - low) // step)
        for value, count in counts.items():
            if low <= value < high:
                bars[(value - low) // step] += count
        peak = bars.max() / number
        path = [f"M0 {HEIGHT:g}"]
        for k, bar in enumerate(bars):
            y = HEIGHT * (1 - bar / max(bars.max(), 1))
            path.append(f"V{y:.1f}H{(k + 1) * step * scale:.1f}")
        found.append(
            Histogram(
                title=title,
                colour=colour,
                count=number,
                mean=sum((v + 0.5) * c for v, c in counts.items()) / number,
                path="".join([*path, f"V{HEIGHT:g}Z"]),
                ticks=tuple((round((t - low) * scale, 1), f"{t:g}") for t in ticks),
                peak=peak / step,
            )
        )
    return found


@dataclass(frozen=True)
class Calibration:
    """Shares of errors below once and twice their uncertainty, by groups of rising uncertainty.

    ``groups``: (x, y of the one, y of the other, mean uncertainty, what to say); ``right``: (y,
    share in percent) of both where the uncertainty is right.
    """

    groups: tuple[tuple[float, float, float, str, str], ...]
    right: tuple[tuple[float, str], ...]


def calibration(deciles: Sequence[Mapping[str, float]]) -> Calibration | None:
    """Groups of labels (deciles of their uncertainty) in a frame of ``WIDTH`` by ``HEIGHT``."""
    if not deciles:
        return None

    def y(share: float) -> float:
        return round(HEIGHT * (1 - share), 1)

    step = WIDTH / len(deciles)
    groups = []
    for k, group in enumerate(deciles):
        once, twice = group["share_below_1"], group["share_below_2"]
        sigma = f"{group['mean_uncertainty']:.3f}"
        text = f"uncertainty {sigma} px: {100 * once:.1f} % below once, {100 * twice:.1f} % twice"
        groups.append((round((k + 0.5) * step, 1), y(once), y(twice), sigma, text))
    return Calibration(tuple(groups), tuple((y(p / 100), f"{p} %") for p in (68.3, 95.4)))
