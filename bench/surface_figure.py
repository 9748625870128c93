"""The figure of docs/explanation/surface.md: facets, breaklines and prisms of a gabled house.

One command; see README.md beside this file. Everything follows from points strewn over surfaces of
known heights: no image, no data.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from stereotruth.lidar.lattice import LATTICE_M
from stereotruth.pages.pictures import save_figure
from stereotruth.surface.scale import SurfaceScale
from stereotruth.surface.surface import GroundSurface, ground_surface
from stereotruth.surface.vertices import VertexBuilder

Floats = NDArray[np.float64]

CELL, CELL_M = (3000, 3000), 0.33  # lattice steps at the equator
SPACING_M, SIDE_M, NOISE_M = 1.0, 32.0, 0.03
TURN = np.radians(22.0)
ROOF, OPEN, PRISM = "#b5651d", "#f4c7c3", "#b3261e"
RAY = "#1f5a99"


def heights(x: Floats, y: Floats) -> Floats:
    """Gently sloping ground, a gabled house and a shed with a flat roof, m."""
    u, v = x - 15.0, y - 17.0
    u, v = u * np.cos(TURN) + v * np.sin(TURN), v * np.cos(TURN) - u * np.sin(TURN)
    ground = 0.04 * x
    house = (np.abs(u) < 8.0) & (np.abs(v) < 5.5)
    shed = (np.abs(u - 12.0) < 2.5) & (np.abs(v + 3.0) < 3.0)
    ground = np.where(shed, 3.0, ground)
    return np.where(house, 9.0 - 0.55 * np.abs(v), ground)


def surface_of_points() -> tuple[GroundSurface, Floats]:
    """The surface of points a metre apart, and these [3, n] (m)."""
    rng = np.random.default_rng(3)
    x, y = np.mgrid[0:SIDE_M:SPACING_M, 0:SIDE_M:SPACING_M].reshape(2, -1)
    x, y = (c + rng.uniform(-0.35, 0.35, c.size) * SPACING_M + 1.0 for c in (x, y))
    h = heights(x, y) + rng.normal(0.0, NOISE_M, x.size)
    scale = SurfaceScale.of(SPACING_M**-2, CELL)
    builder = VertexBuilder(scale, (0, 0), (400_000, 400_000))
    lon, lat = (np.rint(c / CELL_M * CELL[0]).astype(np.int64) for c in (x, y))
    ground, first = np.full(x.size, 2, np.uint8), np.ones(x.size, np.uint8)
    days = np.zeros(x.size, np.uint16)
    builder.add(lon, lat, np.rint(h / LATTICE_M).astype(np.int64), ground, first, days)
    return ground_surface(builder.built(), scale), np.stack([x, y, h])


def corners(surface: GroundSurface, corner: NDArray[np.int32]) -> Floats:
    """x, y, height [n, 3, 3] (m) of triangles."""
    v = surface.vertices
    x, y = (q[corner] / CELL[0] * CELL_M for q in (v.lon_q, v.lat_q))
    return np.stack([x, y, v.h_q[corner] * LATTICE_M], axis=2)


def plan(axis: Axes, surface: GroundSurface, points: Floats) -> None:
    """Facets by height, strips and undecided triangles from above."""
    facets = corners(surface, surface.facet)
    shades = PolyCollection(facets[..., :2], array=facets[..., 2].mean(axis=1), cmap="YlOrBr")
    shades.set_edgecolor("#7a6a55")
    shades.set_linewidth(0.35)
    axis.add_collection(shades)
    strips = corners(surface, surface.undecided[surface.strips])
    whole = corners(surface, surface.undecided[: surface.whole])
    axis.add_collection(PolyCollection(whole[..., :2], facecolor=OPEN, edgecolor=PRISM, lw=0.5))
    axis.add_collection(PolyCollection(strips[..., :2], facecolor=PRISM, edgecolor="none"))
    axis.plot(points[0], points[1], ".", ms=1.6, color="black")
    axis.set(xlim=(2, 31), ylim=(4, 31), aspect="equal", xlabel="x, m", ylabel="y, m")
    axis.set_title("from above: facets, strips (red), undecided triangles (pink)", fontsize=9)


def cut_at(triangles: Floats, y: float) -> list[Floats]:
    """Where triangles meet the vertical plane at ``y``: x, height [2, 2] of both ends."""
    segments = []
    for one in triangles:
        ends = []
        for a, b in ((0, 1), (1, 2), (2, 0)):
            low, high = one[a], one[b]
            if (low[1] - y) * (high[1] - y) < 0:
                part = (y - low[1]) / (high[1] - low[1])
                ends.append((low + part * (high - low))[[0, 2]])
        if len(ends) == 2:
            segments.append(np.array(sorted(ends, key=lambda end: end[0])))
    return segments


def profile(axis: Axes, surface: GroundSurface, points: Floats, y: float) -> None:
    """A vertical cut: facets, prisms, and the rays of both cameras beside the wall."""
    for start, end in cut_at(corners(surface, surface.facet), y):
        axis.plot(*zip(start, end), color=ROOF, lw=2.0)
    undecided = corners(surface, surface.undecided)
    ranges = surface.height_range * LATTICE_M
    for one, (low, high) in zip(undecided, ranges):
        for start, end in cut_at(one[None], y):
            prism = [(start[0], low), (end[0], low), (end[0], high), (start[0], high)]
            axis.add_patch(Polygon(prism, facecolor=OPEN, edgecolor=PRISM, lw=0.6))
    near = np.abs(points[1] - y) < 0.5
    axis.plot(points[0][near], points[2][near], ".", ms=4, color="black")
    foot = 21.0, 0.04 * 21.0
    for tilt, word in ((-0.9, "to the left camera"), (0.25, "to the right camera")):
        tip = foot[0] + tilt * 8.0, foot[1] + 8.0
        arrow = {"arrowstyle": "->", "color": RAY, "lw": 1.2}
        axis.annotate("", tip, foot, arrowprops=arrow)
        axis.text(tip[0], tip[1] + 0.3, word, fontsize=8, color=RAY, ha="center")
    axis.set(xlim=(2, 31), ylim=(-0.5, 11.5), xlabel="x, m", ylabel="height, m")
    axis.set_title(f"cut at y = {y:g} m: facets (brown), prisms (red), points", fontsize=9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, default=Path("docs/surface.png"))
    options = parser.parse_args()
    surface, points = surface_of_points()
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    plan(left, surface, points)
    profile(right, surface, points, 12.0)
    save_figure(options.figure, figure, dpi=90)
    print(
        f"{options.figure}: {len(surface.facet)} facets, {surface.whole} undecided triangles, "
        f"{len(surface.undecided) - surface.whole} strips"
    )


if __name__ == "__main__":
    main()
