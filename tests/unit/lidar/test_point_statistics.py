"""Density and roughness of points on made ground."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_statistics import points_per_m2, roughness_m
from stereotruth.lidar.point_store import PointStore

from ...synthetic.las import write_las

CORNER = np.array([500_040.0, 3_390_070.0])
Ground = Callable[[np.ndarray], np.ndarray]


def level(xy: np.ndarray) -> np.ndarray:
    return np.full(len(xy), 50.0)


def slope(xy: np.ndarray) -> np.ndarray:
    return 50.0 + 0.3 * xy[:, 0] - 0.2 * xy[:, 1]


def houses(xy: np.ndarray) -> np.ndarray:
    """Of 6 m, 10 m wide, every 20 m, on a slope."""
    return slope(xy) + 6.0 * (xy % 20.0 < 10.0).all(axis=1)


def strewn(
    folder: Path, box: tuple[float, ...], density: float, ground: Ground = level
) -> PointStore:
    """A store of points strewn at random over a box (west, south, east, north) of metres."""
    seed = len(list(folder.glob("*.las")))
    rng = np.random.default_rng(seed)
    count = round((box[2] - box[0]) * (box[3] - box[1]) * density)
    xy = rng.uniform(box[:2], box[2:], (count, 2))
    file = folder / f"{seed}.las"
    write_las(file, xyz=np.column_stack([CORNER + xy, ground(xy)]))
    ingest(file, file.with_suffix(".points"))
    return PointStore(file.with_suffix(".points"))


@pytest.mark.parametrize("density", [0.1, 12.0])
@pytest.mark.parametrize("side", [(400.0, 300.0), (50.0, 60.0), (400.0, 40.0)])
def test_density_of_a_survey_of_any_size(tmp_path, density, side):
    """Cells are 117 m wide: hardly one of them is full."""
    store = strewn(tmp_path, (0.0, 0.0, *side), density)
    tolerance = 0.03 + 2.0 / np.sqrt(density * side[0] * side[1])  # there are that many
    assert points_per_m2([store]) == pytest.approx(density, rel=tolerance)


def test_files_side_by_side_and_over_each_other(tmp_path):
    boxes = (0.0, 0.0, 130.0, 200.0), (130.0, 0.0, 300.0, 200.0)
    beside = [strewn(tmp_path, box, 4.0) for box in boxes]
    over = [strewn(tmp_path, (0.0, 0.0, 300.0, 200.0), 2.0), *beside]
    assert points_per_m2(beside) == pytest.approx(4.0, rel=0.03)
    assert points_per_m2(over) == pytest.approx(6.0, rel=0.03)
    assert points_per_m2(over) == points_per_m2(over[::-1])


def test_lakes_are_no_ground_that_is_covered(tmp_path):
    shores = (0.0, 0.0, 300.0, 60.0), (0.0, 240.0, 300.0, 300.0)
    stores = [strewn(tmp_path, box, 5.0) for box in shores]
    assert points_per_m2(stores) == pytest.approx(5.0, rel=0.03)


@pytest.mark.parametrize("density", [1.0, 16.0])
def test_steps_of_houses_count_at_any_density(tmp_path, density):
    """Each has two steps of 6 m in ten squares of the lines that cross it.

    Those are 0.6 of all lines, as squares that hold a part of a house stand as high as it.
    """
    stores = [strewn(tmp_path, (0.0, 0.0, 300.0, 300.0), density, houses)]
    assert roughness_m(stores) == pytest.approx(0.6 * 2.0 * 6.0 / 10.0, rel=0.12)


def test_a_slope_is_not_rough_and_few_points_tell_nothing(tmp_path):
    box = (0.0, 0.0, 300.0, 300.0)
    assert roughness_m([strewn(tmp_path, box, 4.0, slope)]) < 0.01
    assert roughness_m([strewn(tmp_path, box, 0.01, houses)]) is None
