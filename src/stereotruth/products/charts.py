"""Line and point charts of pages, as geometry in the units of their SVG view boxes (y down).

Series differ in colour, in the shape of their points and in the dashes of their lines, so that
they stay apart without colour. ``parts.html.jinja`` draws them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.ticker import LogLocator, MaxNLocator

from .html_tables import minus
from .pictures import SERIES

WIDTH, HEIGHT = 460.0, 260.0
LEFT = 56.0  # of the axis: room for its numbers
DASHES = ("", "8 4", "2 3", "12 3 2 3", "5 2", "1 2")
SHAPES = 6


@dataclass(frozen=True)
class Point:
    """A point at (x, y), what to say of it, the ends of its interval along x, where it leads."""

    x: float
    y: float
    text: str
    low: float | None = None
    high: float | None = None
    href: str = ""


@dataclass(frozen=True)
class Series:
    """Points of one kind, or a line (an SVG path), perhaps ``filled``."""

    name: str
    colour: str
    shape: int = 0
    dash: str = ""
    path: str = ""
    points: tuple[Point, ...] = ()
    filled: bool = False


@dataclass(frozen=True)
class Axis:
    """From values of ``low`` … ``high`` to 0 … ``length``; ``turned``: upwards on the page.

    ``log``: by logarithms; ``linear_to``: by logarithms of either sign (asinh), linear up to there.
    """

    low: float
    high: float
    length: float
    log: bool = False
    turned: bool = False
    linear_to: float | None = None

    def at(self, value: float) -> float:
        """Where a value stands; what is beyond the ends stands at them."""
        value = min(max(value, self.low), self.high)
        value, low, high = (self._scaled(v) for v in (value, self.low, self.high))
        share = (value - low) / (high - low)
        return round(self.length * ((1 - share) if self.turned else share), 1)

    def _scaled(self, value: float) -> float:
        if self.log:
            return math.log(value)
        return value if self.linear_to is None else math.asinh(value / self.linear_to)

    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Places and texts."""
        if self.linear_to is None:
            locator = (
                LogLocator(10, (1, 2, 5)) if self.log else MaxNLocator(6, steps=(1, 2, 2.5, 5, 10))
            )
            values = [round(float(v), 10) for v in locator.tick_values(self.low, self.high)]
        else:
            sizes = [10.0**k for k in range(-3, 4) if 10.0**k >= self.linear_to]
            values = [-v for v in sizes[::-1]] + [0.0] + sizes
        inside = [v for v in values if self.low <= v <= self.high]
        if len(inside) > 8:  # decades alone
            inside = [v for v in inside if f"{v:e}"[0] == "1"]
        return tuple((self.at(v), minus(f"{v:g}")) for v in inside)


@dataclass(frozen=True)
class Chart:
    """A chart of ``width`` by ``height``; ``band``: a box (x, y, width, height) behind all."""

    title: str
    caption: str
    x_title: str
    y_title: str
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    series: tuple[Series, ...]
    width: float = WIDTH
    height: float = HEIGHT
    left: float = LEFT
    band: tuple[float, float, float, float] | None = None


def look(number: int) -> tuple[str, int, str]:
    """Colour, shape and dashes of the n-th series."""
    return SERIES[number % len(SERIES)], number % SHAPES, DASHES[number % len(DASHES)]


def line(x: Axis, y: Axis, points: Sequence[tuple[float, float]]) -> str:
    """The path through points (in values), an SVG path."""
    return "M" + "L".join(f"{x.at(a):g} {y.at(b):g}" for a, b in points)
