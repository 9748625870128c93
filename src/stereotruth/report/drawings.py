"""A page's residuals as arrows, and its charts: histograms of disparities, calibration.

In the units of their SVG view boxes (y down).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..pages.figures import Axis, Chart, Point, Series, look
from ..pages.tables import minus
from ..pages.pictures import round_length

SIDE = 300.0  # longer side of a frame of residuals
SHARE = 1 / 8  # of the frame, taken by the longest arrow
WIDTH, HEIGHT = 420.0, 150.0  # of a histogram
BARS = 80  # most bars of a histogram
RIGHT = (68.3, 95.4)  # % of normal errors below once and twice their uncertainty


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


def histograms(counted: Sequence[tuple[str, str, Mapping[int, int]]]) -> list[Chart]:
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
    x = Axis(low, high, WIDTH)
    return [
        _histogram(title, colour, counts, x, step)
        for title, colour, counts in counted
        if sum(counts.values())
    ]


def _histogram(title: str, colour: str, counts: Mapping[int, int], x: Axis, step: int) -> Chart:
    """The histogram of one kind of pixels, in columns of ``step`` px."""
    number = sum(counts.values())
    bars = np.zeros(round((x.high - x.low) / step))
    for value, count in counts.items():
        if x.low <= value < x.high:
            bars[round(value - x.low) // step] += count
    y = Axis(0.0, max(100 * float(bars.max()) / number / step, 1e-9), HEIGHT, turned=True)
    path = [f"M0 {HEIGHT:g}"]
    for k, bar in enumerate(bars):
        path.append(f"V{y.at(100 * bar / number / step):g}H{x.at(x.low + (k + 1) * step):g}")
    mean = sum((v + 0.5) * c for v, c in counts.items()) / number
    area = Series(title, colour, path="".join([*path, f"V{HEIGHT:g}Z"]), filled=True)
    return Chart(
        title=f"histogram of disparities, {title}",
        caption=f"{number / 1e6:.2f} million labels, mean {minus(f'{mean:.1f}')} px",
        x_title="disparity, px",
        y_title="% of the labels per px",
        x_ticks=x.ticks(),
        y_ticks=y.ticks()[-1:],
        series=(area,),
        width=WIDTH,
        height=HEIGHT,
    )


def calibration(deciles: Sequence[Mapping[str, float]], caption: str) -> Chart | None:
    """Shares of errors below once and twice their uncertainty, by groups of rising uncertainty.

    ``deciles``: of the labels, by their uncertainty; dashed lines stand where it is right.
    """
    if not deciles:
        return None
    y = Axis(0.0, 100.0, HEIGHT, turned=True)
    step = WIDTH / len(deciles)
    once, twice, ticks = [], [], []
    for k, group in enumerate(deciles):
        shares = 100 * group["share_below_1"], 100 * group["share_below_2"]
        sigma, at = f"{group['mean_uncertainty']:.3f}", round((k + 0.5) * step, 1)
        text = f"uncertainty {sigma} px: {shares[0]:.1f} % below once, {shares[1]:.1f} % twice"
        once.append(Point(at, y.at(shares[0]), text))
        twice.append(Point(at, y.at(shares[1]), text))
        ticks.append((at, sigma))
    right = "".join(f"M0 {y.at(p):g}H{WIDTH:g}" for p in RIGHT)
    return Chart(
        title="shares of the errors below their uncertainty",
        caption=caption,
        x_title="uncertainty, px: groups of labels",
        y_title="",
        x_ticks=tuple(ticks),
        y_ticks=tuple((y.at(p), f"{p:g} %") for p in (0.0, *RIGHT)),
        series=(
            Series("below once", look(0)[0], points=tuple(once)),
            Series("below twice", look(1)[0], shape=1, points=tuple(twice)),
            Series("where it is right", "var(--dim)", dash="5 4", path=right),
        ),
        width=WIDTH,
        height=HEIGHT,
    )
