"""The layer lidar_date: two surveys of a plane with a box, one from the west, one from the east."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from stereotruth.core.config.labels import LabelSettings
from stereotruth.core.products.grids import require_complete
from stereotruth.core.status import is_labelled
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.gps_times import day_of
from stereotruth.lidar.point_store import open_stores
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.surface_store import SurfaceStore

from ...synthetic.box_scene import Scene, project_with, surfaces_of, write_points
from ...synthetic.cameras import LON
from ...synthetic.stores import tree_digest

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


@pytest.mark.parametrize("view", ["left", "right"])
@pytest.mark.parametrize(
    ("west", "east", "told"),
    [
        ({"day": WEST}, {"day": EAST}, (WEST, EAST)),
        ({"day": WEST}, {}, (WEST, 0)),
        ({"acquired": ["2019-03-01", "2019-03-05"]}, {"day": EAST}, (17_958, EAST)),
        ({}, {}, (0, 0)),
    ],
)
def test_labels_have_the_day_of_their_survey(box, tmp_path, view, west, east, told):
    stores = surveys(box, tmp_path, west, east)
    project_with(*box.images, stores, tmp_path / "out.zarr", view=view)
    days, metres = dates(tmp_path / "out.zarr", view)
    assert (days[metres < -NEAR_M] == told[0]).all()
    assert (days[metres > NEAR_M] == told[1]).all()
    assert set(days.tolist()) == set(told)


def test_nothing_else_depends_on_days(box, tmp_path):
    layers = []
    for name, days in (("none", ({}, {})), ("two", ({"day": WEST}, {"day": EAST}))):
        stores = surveys(box, tmp_path / name, *days)
        project_with(*box.images, stores, tmp_path / name / "out.zarr")
        grid = require_complete(tmp_path / name / "out.zarr")
        layers.append({key: grid[key][:].tobytes() for key in grid.array_keys()})
    none, two = layers
    assert none.pop("lidar_date") != two.pop("lidar_date")
    assert none == two and "disparity" in two


@pytest.mark.slow
def test_bytes_are_the_same_for_any_blocks_windows_and_workers(box, tmp_path):
    """Points of one file of both days, in the order of a file that mixes them."""
    day = np.where(box.points[:, 0] < LON, WEST, EAST)
    mixed = np.random.default_rng(1).permutation(len(day))
    store = write_points(tmp_path, box.points[mixed], day=day[mixed])
    inputs = SceneInputs.of(*box.images, [store], LabelSettings())
    digests = set()
    for number, (blocks, run) in enumerate(
        [(1, {}), (16, {"max_points": 20_000}), (3, {"workers": 2, "scheduler": "sync"})]
    ):
        folder = tmp_path / str(number)
        make_surface(
            open_stores([store]), folder / "s", cell=inputs.rays.cell, blocks_at_once=blocks
        )
        project_with(*box.images, [store], folder / "out.zarr", surface=folder / "s", **run)
        digests.add((SurfaceStore(folder / "s").every, tree_digest(folder / "out.zarr")))
    assert len(digests) == 1
    days, metres = dates(tmp_path / "0/out.zarr", "left")
    assert (
        days[abs(metres) > NEAR_M] == np.where(metres < 0, WEST, EAST)[abs(metres) > NEAR_M]
    ).all()


def test_xarray_reads_dates(box, tmp_path):
    stores = surveys(box, tmp_path, {"day": WEST}, {})
    project_with(*box.images, stores, tmp_path / "out.zarr")
    layer = xr.open_zarr(tmp_path / "out.zarr")["lidar_date"]
    found = {str(day)[:10] for day in np.unique(layer.values)}
    assert found == {day_of(WEST), "NaT"}


@pytest.mark.parametrize("view", ["left", "right"])
def test_labels_of_the_recipe_paper_have_the_day_of_their_highest_point(box, tmp_path, view):
    """A third survey has each point once more, 1 cm lower: it is the highest where the other one
    lies in the next pixel."""
    stores = surveys(box, tmp_path, {"day": WEST}, {"day": EAST})
    stores.append(write_points(tmp_path, box.points - [0.0, 0.0, 0.01], "lower", day=UNDER))
    project_with(*box.images, stores, tmp_path / "out.zarr", view=view, recipe="paper")
    days, metres = dates(tmp_path / "out.zarr", view)
    assert (days == UNDER).mean() < 0.02
    of_two = days != UNDER
    days, metres = days[of_two], metres[of_two]
    assert (days[metres < -NEAR_M] == WEST).all() and (days[metres > NEAR_M] == EAST).all()
