"""A town, simulated once."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereocities.cities import lidar_files
from stereocities.control_points import simulate_points
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import simulate_image
from stereocities.truth import simulate_truth

from ...synthetic.small_cities import TOWN


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("Town-1")
    scene = TOWN.scenes[0]
    for view in ("left", "right"):
        simulate_image(TOWN, scene, view, folder / f"{view}.tif", seed=1)
    for name in lidar_files(TOWN, scene):
        simulate_lidar_tile(TOWN, scene, name, folder / "lidar" / name, seed=1)
    simulate_truth(TOWN, scene, folder / "truth.zarr")
    simulate_points(
        TOWN, scene, folder / "gcps.csv", folder / "exact.csv", folder / "checks.csv", seed=1
    )
    return folder
