"""How rough a site is, by points on made ground."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_statistics import roughness_m
from stereotruth.lidar.point_store import PointStore

from ...synthetic.las import write_las

CORNER = np.array([500_040.0, 3_390_070.0])
SIDE_M = 300.0
Ground = Callable[[np.ndarray], np.ndarray]


def strewn(folder: Path, name: str, ground: Ground, density: float = 4.0) -> PointStore:
    """A store of points strewn at random over ground whose height follows from metres [n, 2]."""
    rng = np.random.default_rng(len(name))
    xy = rng.uniform(0.0, SIDE_M, (round(SIDE_M**2 * density), 2))
    write_las(folder / f"{name}.las", xyz=np.column_stack([CORNER + xy, ground(xy)]))
    ingest(folder / f"{name}.las", folder / f"{name}.points")
    return PointStore(folder / f"{name}.points")


def slope(xy: np.ndarray) -> np.ndarray:
    return 50.0 + 0.3 * xy[:, 0] - 0.2 * xy[:, 1]


def houses(xy: np.ndarray) -> np.ndarray:
    """Of 6 m, 10 m wide, every 20 m, on a slope."""
    return slope(xy) + 6.0 * (xy % 20.0 < 10.0).all(axis=1)


@pytest.mark.parametrize("density", [1.0, 4.0, 16.0])
def test_steps_of_houses_count_at_any_density(tmp_path, density):
    """Each has two steps of 6 m in ten squares of the lines that cross it.

    Those are 0.6 of all lines, as squares that hold a part of a house stand as high as it.
    """
    found = roughness_m([strewn(tmp_path, "a", houses, density)])
    assert found == pytest.approx(0.6 * 2.0 * 6.0 / 10.0, rel=0.12)


def test_a_slope_is_not_rough(tmp_path):
    assert roughness_m([strewn(tmp_path, "a", slope)]) < 0.01


def test_any_order_of_stores(tmp_path):
    stores = [strewn(tmp_path, name, ground) for name, ground in (("a", houses), ("bb", slope))]
    assert roughness_m(stores) == roughness_m(stores[::-1])


def test_few_points_tell_nothing(tmp_path):
    assert roughness_m([strewn(tmp_path, "a", houses, 0.01)]) is None
