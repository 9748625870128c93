"""Small synthetic cities whose files look like a user's own: a pair, and a site of images."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

from stereocities.cities import Character, CitySpec, SceneSpec, lidar_files
from stereocities.control_points import simulate_points
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import simulate_image
from stereocities.sites import SiteSpec, images_drawn, simulate_site_image, simulate_site_points

from ..core.sheets import Image

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
TILES = "tiles: # the example's images are small", "  size: 256"


SITE_CITY = replace(
    DEMO,
    name="Stack",
    scenes=(SceneSpec("Stack", (0.0, 0.0), 600, 600, 5, lidar_grid=(2, 1), ragged_m=(0.0, 0.0)),),
)
SITE = SiteSpec(SITE_CITY, images_drawn("Stack", SITE_CITY, 6, 560, seed=9))


def make_example(folder: Path) -> str:
    """The pair: images, LiDAR and control points below ``folder``, its rows and settings."""
    (scene,) = DEMO.scenes
    data, points = folder / "data" / scene.name, folder / "gcps" / f"{scene.name}.csv"
    simulate_points(
        DEMO, scene, points, data / "gcps_exact.csv", data / "checkpoints.csv", seed=SEED
    )
    for view in ("left", "right"):
        simulate_image(DEMO, scene, view, data / f"{view}.tif", seed=SEED)
    _make_lidar(DEMO, data / "lidar")
    inside = data.relative_to(folder)
    row = {
        "scene": scene.name,
        "city": DEMO.name,
        "left_image": f"{inside}/left.tif",
        "right_image": f"{inside}/right.tif",
        "lidar": f"{inside}/lidar",
        "gcps": f"gcps/{scene.name}.csv",
    }
    append_row(folder / "scenes.tsv", row)
    append_row(folder / "cities.tsv", city_row(DEMO.name, "DM"))
    append_settings(folder, TILES)
    return "stereotruth check"


def make_site(folder: Path) -> str:
    """The site: images with their sheet, LiDAR and control points; no pair is chosen yet."""
    data, points = folder / "data", folder / "gcps" / f"{SITE.city.name}.csv"
    simulate_site_points(SITE, points, data / "gcps_exact.csv", seed=SEED)
    _make_lidar(SITE.city, data / "lidar")
    sheet = folder / "images.tsv"
    sheet.write_text("\t".join(field.name for field in fields(Image)) + "\n", encoding="utf-8")
    for image in SITE.images:
        file = data / f"{image.name}.tif"
        simulate_site_image(SITE, image, file, seed=SEED)
        acquired = image.acquired.strftime("%Y-%m-%dT%H:%M:%SZ")
        row = {
            "image": image.name,
            "city": SITE.city.name,
            "file": file.relative_to(folder),
            "acquired": acquired,
        }
        append_row(sheet, row)
    append_row(folder / "cities.tsv", city_row(SITE.city.name, "ST"))
    append_settings(folder, ["images: images.tsv", *TILES])
    return (
        f"stereotruth pairs {SITE.city.name} --most 4 --lidar data/lidar "
        f"--gcps gcps/{SITE.city.name}.csv"
    )


EXAMPLES = {"demo": make_example, "site": make_site}


def _make_lidar(city: CitySpec, folder: Path) -> None:
    """The LiDAR of the city's one scene."""
    (scene,) = city.scenes
    for file in lidar_files(city, scene):
        simulate_lidar_tile(city, scene, file, folder / file, spacing_m=SPACING_M, seed=SEED)


def city_row(name: str, prefix: str) -> dict[str, object]:
    """The row of the cities sheet for a small city."""
    return {"city": name, "prefix": prefix, "training": 6, "validation": 1, "testing": 3}


def append_row(sheet: Path, values: dict[str, object]) -> None:
    """One more line of a sheet, in the order of its header."""
    header = sheet.read_text(encoding="utf-8").splitlines()[0].split("\t")
    with sheet.open("a", newline="", encoding="utf-8") as stream:
        csv.DictWriter(stream, header, delimiter="\t", lineterminator="\n").writerow(values)


def append_settings(folder: Path, lines: Sequence[str]) -> None:
    """More lines at the end of a new project's configuration."""
    with (folder / "config.yaml").open("a", encoding="utf-8") as stream:
        stream.write("\n" + "\n".join(lines) + "\n")
