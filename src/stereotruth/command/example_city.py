"""A small synthetic city whose files look like a user's own."""

from __future__ import annotations

import csv
from pathlib import Path

from ..simulate.cities import Character, CitySpec, SceneSpec, lidar_files
from ..simulate.control_points import simulate_points
from ..simulate.lidar import simulate_lidar_tile
from ..simulate.render import simulate_image

DEMO = CitySpec(
    name="Demo",
    lon=114.3,
    lat=30.6,
    epsg=32650,
    base_height_m=20.0,
    world_seed=7,
    character=Character(
        relief_m=8,
        valley=0.2,
        wavelength_m=900,
        max_slope_deg=10,
        river_m=0,
        lakes=0,
        zones={"slabs": 3, "lowrise": 2, "park": 1},
        towers_m=(30, 40),
        trees=0.4,
        zone_m=150.0,
    ),
    scenes=(
        SceneSpec("Demo-1", (0.0, 0.0), 640, 640, 5, lidar_grid=(1, 1), ragged_m=(20.0, 20.0)),
    ),
)
SPACING_M = 0.4
SEED = 1
TILE_PX = 256


def make_example(folder: Path) -> None:
    """Images, LiDAR and control points of the city below ``folder``, and its rows and settings."""
    (scene,) = DEMO.scenes
    data, points = folder / "data" / scene.name, folder / "gcps" / f"{scene.name}.csv"
    simulate_points(
        DEMO, scene, points, data / "gcps_exact.csv", data / "checkpoints.csv", seed=SEED
    )
    for view in ("left", "right"):
        simulate_image(DEMO, scene, view, data / f"{view}.tif", seed=SEED)
    for file in lidar_files(DEMO, scene):
        simulate_lidar_tile(
            DEMO, scene, file, data / "lidar" / file, spacing_m=SPACING_M, seed=SEED
        )
    inside = data.relative_to(folder)
    row = {
        "scene": scene.name,
        "city": DEMO.name,
        "left_image": f"{inside}/left.tif",
        "right_image": f"{inside}/right.tif",
        "lidar": f"{inside}/lidar",
        "gcps": f"gcps/{scene.name}.csv",
    }
    city = {"city": DEMO.name, "prefix": "DM", "training": 6, "validation": 1, "testing": 3}
    for name, values in (("scenes", row), ("cities", city)):
        sheet = folder / f"{name}.tsv"
        header = sheet.read_text(encoding="utf-8").split()
        with sheet.open("a", newline="", encoding="utf-8") as stream:
            csv.DictWriter(stream, header, delimiter="\t", lineterminator="\n").writerow(values)
    with (folder / "config.yaml").open("a", encoding="utf-8") as stream:
        stream.write(f"\ntiles: # the example's images are small\n  size: {TILE_PX}\n")
