"""LiDAR of a made town in strips that are off by known offsets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore

from .las import SOUTH, WEST, write_las

OFFSETS = np.array([[0.0, 0.0, 0.0], [-0.35, 0.25, -0.09], [0.2, -0.3, 0.06]])
DENSITIES = 8.0, 3.0, 5.0  # points/m²
WIDTH, STEP, LENGTH = 110.0, 70.0, 90.0  # m: strips overlap by 40 m
NOISE_M = 0.03


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rolling ground with gabled houses, whose ridges run north and east in turn."""
    ground = 40.0 + 0.03 * x + 2.0 * np.sin(x / 40.0) * np.cos(y / 35.0)
    u, v = x % 25.0 - 12.5, y % 25.0 - 12.5
    turned = (x // 25.0 + y // 25.0) % 2 == 0
    roof = 50.0 + 0.03 * x - 0.5 * np.abs(np.where(turned, u, v))
    return np.where((np.abs(u) < 7.0) & (np.abs(v) < 5.0), roof, ground)


def strip(number: int, offset: np.ndarray) -> np.ndarray:
    """Points [n, 3] of a strip that flies north, line by line from west to east."""
    rng = np.random.default_rng(number)
    spacing = DENSITIES[number] ** -0.5
    y, x = np.meshgrid(np.arange(0, LENGTH, spacing), np.arange(0, WIDTH, spacing), indexing="ij")
    x = (x + rng.uniform(-0.2, 0.2, x.shape) * spacing).reshape(-1) + number * STEP
    y = (y + rng.uniform(-0.2, 0.2, y.shape) * spacing).reshape(-1)
    points = np.column_stack([x, y, height(x, y)])
    return points + offset + rng.normal(0, NOISE_M, points.shape)


def stores(
    folder: Path, offsets: np.ndarray = OFFSETS, told: str = "source", halves: bool = True
) -> list[PointStore]:
    """Point stores of the strips, cut into a southern and a northern file unless it is one.

    ``told``: what tells the strips: source, time (of the week), edges, or nothing.
    """
    folder.mkdir(exist_ok=True)
    every = [strip(k, offset) for k, offset in enumerate(offsets)]
    which = np.repeat(np.arange(len(every)), [len(points) for points in every])
    points = np.concatenate(every)
    single = np.ones(len(points), np.uint8)
    fields = {
        "source": {"point_source_id": 7320 + which},
        "time": {"gps_time": 300_000.0 + 200.0 * which + points[:, 1] / 60.0},
        "edges": {"edge_of_flight_line": _edges(points, which)},
        "nothing": {},
    }[told]
    made = []
    for name, of in (("south", points[:, 1] < 45.0), ("north", points[:, 1] >= 45.0)):
        of = of if halves else np.ones(len(points), np.bool_)
        write_las(
            folder / f"{name}.las",
            xyz=points[of] + [WEST, SOUTH, 0.0],
            pdrf=0 if told == "edges" else 6,
            version="1.2" if told == "edges" else "1.4",
            return_number=single[of],
            number_of_returns=single[of],
            **{field: values[of] for field, values in fields.items()},
        )
        ingest(folder / f"{name}.las", folder / f"{name}.points")
        made.append(PointStore(folder / f"{name}.points"))
        if not halves:
            break
    return made


def _edges(points: np.ndarray, which: np.ndarray) -> np.ndarray:
    """1 for the first and last point of each line of pulses."""
    first = np.append(True, (np.diff(points[:, 0]) < -WIDTH / 2) | (np.diff(which) != 0))
    return (first | np.append(first[1:], True)).astype(np.uint8)
