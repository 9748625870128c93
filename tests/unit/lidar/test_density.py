"""Points over the ground that they cover, where squares and cells are partly filled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_statistics import points_per_m2
from stereotruth.lidar.point_store import PointStore, open_stores

from ...synthetic.las import write_las

CORNER = np.array([500_040.0, 3_390_070.0])


def strewn(
    folder: Path, name: str, west: float, south: float, east: float, north: float, density: float
) -> Path:
    """A store of points strewn at random over a box of metres from the corner."""
    rng = np.random.default_rng(len(name))
    count = round((east - west) * (north - south) * density)
    xy = CORNER + rng.uniform((west, south), (east, north), (count, 2))
    write_las(folder / f"{name}.las", xyz=np.column_stack([xy, np.full(count, 50.0)]))
    ingest(folder / f"{name}.las", folder / f"{name}.points")
    return folder / f"{name}.points"


@pytest.mark.parametrize("density", [0.1, 0.25, 1.0, 12.0])
@pytest.mark.parametrize("side", [(400.0, 300.0), (50.0, 60.0), (400.0, 40.0)])
def test_density_of_a_survey_of_any_size(tmp_path, density, side):
    """Cells are 117 m wide: hardly one of them is full."""
    store = strewn(tmp_path, "a", 0.0, 0.0, *side, density)
    tolerance = 0.03 + 2.0 / np.sqrt(density * side[0] * side[1])  # there are that many
    assert points_per_m2([PointStore(store)]) == pytest.approx(density, rel=tolerance)


def test_files_side_by_side_and_over_each_other(tmp_path):
    west = strewn(tmp_path, "west", 0.0, 0.0, 130.0, 200.0, 4.0)
    east = strewn(tmp_path, "eastern", 130.0, 0.0, 300.0, 200.0, 4.0)
    again = strewn(tmp_path, "a second flight", 0.0, 0.0, 300.0, 200.0, 2.0)
    beside, over = open_stores([west, east]), open_stores([again, east, west])
    assert points_per_m2(beside) == pytest.approx(4.0, rel=0.03)
    assert points_per_m2(over) == pytest.approx(6.0, rel=0.03)
    assert points_per_m2(over) == points_per_m2(over[::-1])


def test_lakes_are_no_ground_that_is_covered(tmp_path):
    shores = [
        strewn(tmp_path, "s", 0.0, 0.0, 300.0, 60.0, 5.0),
        strewn(tmp_path, "north", 0.0, 240.0, 300.0, 300.0, 5.0),
    ]
    assert points_per_m2(open_stores(shores)) == pytest.approx(5.0, rel=0.03)


def test_squares_count_every_point(tmp_path):
    store = PointStore(strewn(tmp_path, "a", 0.0, 0.0, 200.0, 100.0, 1.0))
    assert np.array_equal(store.square_counts.sum(axis=(1, 2)), store.cell_counts)
