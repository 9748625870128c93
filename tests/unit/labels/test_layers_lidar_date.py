"""The layer lidar_date: two surveys of a plane with a box, one from the west, one from the east."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from stereotruth.core.products.grids import require_complete
from stereotruth.core.status import is_labelled
from stereotruth.lidar.point_fields import day_of

from ...synthetic.box_scene import Scene, project_with, surfaces_of, write_points
from ...synthetic.cameras import LON

WEST, EAST, UNDER = 17_000, 18_400, 18_500  # days
NEAR_M = 1.5  # of the border of both surveys: two spacings of points and a pixel


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("box"), box=True, noise=0.05)


def surveys(scene: Scene, folder: Path, west: dict, east: dict) -> list[Path]:
    """Stores of the points on both sides of the middle of the box."""
    is_west = scene.points[:, 0] < LON
    return [
        write_points(folder, scene.points[is_west], "west", **west),
        write_points(folder, scene.points[~is_west], "east", **east),
    ]


def dates(out: Path, view: str) -> tuple[np.ndarray, ...]:
    """Days of labels [n], and where they are on the ground: m to the east."""
    grid = require_complete(out)
    days, labelled = grid["lidar_date"][:], is_labelled(grid["status"][:])
    assert (days[~labelled] == 0).all() and labelled.sum() > 30_000
    _, *views = surfaces_of(True)
    east = views[("left", "right").index(view)][0]
    return days[labelled], east[labelled]


@pytest.mark.parametrize(
    ("view", "west", "east", "told"),
    [
        ("left", {"day": WEST}, {}, (WEST, 0)),
        ("right", {"acquired": ["2019-03-01", "2019-03-05"]}, {"day": EAST}, (17_958, EAST)),
    ],
)
def test_labels_have_the_day_of_their_survey(box, tmp_path, view, west, east, told):
    """As Zarr has it and as xarray does; where a survey has no day, there is none."""
    stores = surveys(box, tmp_path, west, east)
    project_with(*box.images, stores, tmp_path / "out.zarr", view=view)
    days, metres = dates(tmp_path / "out.zarr", view)
    assert (days[metres < -NEAR_M] == told[0]).all()
    assert (days[metres > NEAR_M] == told[1]).all()
    assert set(days.tolist()) == set(told)
    layer = xr.open_zarr(tmp_path / "out.zarr")["lidar_date"]
    found = {str(day)[:10] for day in np.unique(layer.values)}
    assert found == {"NaT", *(day_of(day) for day in told if day)}


def test_labels_of_the_recipe_paper_have_the_day_of_their_highest_point(box, tmp_path):
    """A third survey has each point once more, 1 cm lower: it is the highest where the other one
    lies in the next pixel."""
    stores = surveys(box, tmp_path, {"day": WEST}, {"day": EAST})
    stores.append(write_points(tmp_path, box.points - [0.0, 0.0, 0.01], "lower", day=UNDER))
    project_with(*box.images, stores, tmp_path / "out.zarr", view="right", recipe="paper")
    days, metres = dates(tmp_path / "out.zarr", "right")
    assert (days == UNDER).mean() < 0.02
    of_two = days != UNDER
    days, metres = days[of_two], metres[of_two]
    assert (days[metres < -NEAR_M] == WEST).all() and (days[metres > NEAR_M] == EAST).all()
