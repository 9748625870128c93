"""Projects whose input is simulated: examples (a pair, a site), and twins of real places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stereocities.cities import (
    LEFT_GSD_M,
    Character,
    CitySpec,
    SceneSpec,
    file_of,
    lidar_files,
    write_city,
)
from stereocities.control_points import simulate_points
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import simulate_image
from stereocities.sites import SiteSpec, images_drawn, simulate_site_image, simulate_site_points
from stereocities.twin_world import SUN_DEG, twin_city

from ..core.errors import InputError
from .new_project import append_row, begin, city_row

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

NAME, PREFIX = "Twin", "TW"
LEAST_PX = 256  # of the left image's shorter side: fewer have no tile
DENSITY = 1 / 0.4**2  # points per m², that of the six cities
DENSITIES = 0.04, 100.0  # points per m², what simulate.lidar_spacing_m can be


def make_example(folder: Path) -> str:
    """The pair: images, LiDAR and control points below ``folder``, its rows and settings; and the
    city's file, of which `evaluate` makes the exact truth."""
    (scene,) = DEMO.scenes
    write_city(DEMO, folder / file_of(DEMO.name))
    data, points = folder / "data" / scene.name, folder / "gcps" / f"{scene.name}.csv"
    simulate_points(
        DEMO, scene, points, data / "gcps_exact.csv", data / "checkpoints.csv", seed=SEED
    )
    for view in ("left", "right"):
        simulate_image(DEMO, scene, view, data / f"{view}.tif", seed=SEED)
    _make_lidar(DEMO, data / "lidar")
    _append_scene(
        folder, scene.name, DEMO.name, data.relative_to(folder), points.relative_to(folder)
    )
    append_row(folder / "cities.tsv", city_row(DEMO.name, "DM"))
    append_settings(folder, TILES)
    return "stereotruth check"


def make_site(folder: Path) -> str:
    """The site: images with their sheet, LiDAR and control points; no pair is chosen yet."""
    data, points = folder / "data", folder / "gcps" / f"{SITE.city.name}.csv"
    simulate_site_points(SITE, points, data / "gcps_exact.csv", seed=SEED)
    _make_lidar(SITE.city, data / "lidar")
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
        append_row(folder / "images.tsv", row)
    append_row(folder / "cities.tsv", city_row(SITE.city.name, "ST"))
    append_settings(folder, TILES)
    return (
        f"stereotruth pairs {SITE.city.name} --most 4 --lidar data/lidar "
        f"--gcps gcps/{SITE.city.name}.csv"
    )


EXAMPLES = {"demo": make_example, "site": make_site}


def with_example(folder: str | Path, name: str) -> str:
    """A new project with a small synthetic city, ``demo`` or ``site``; returns the next step.

    Images, LiDAR and control points are made here. Raises InputError for another name.
    """
    if name not in EXAMPLES:
        raise InputError(
            f"no example {name!r}", remedy=f"take one of {', '.join(EXAMPLES)} after --example"
        )
    begin(folder)
    return EXAMPLES[name](Path(folder))


def _make_lidar(city: CitySpec, folder: Path) -> None:
    """The LiDAR of the city's one scene."""
    (scene,) = city.scenes
    for file in lidar_files(city, scene):
        simulate_lidar_tile(city, scene, file, folder / file, spacing_m=SPACING_M, seed=SEED)


def _append_scene(folder: Path, scene: str, city: str, data: Path, gcps: Path) -> None:
    """The row of a scene whose images and LiDAR lie in ``data``; paths from ``folder`` on."""
    images = {f"{view}_image": data / f"{view}.tif" for view in ("left", "right")}
    row = {"scene": scene, "city": city, **images, "lidar": data / "lidar", "gcps": gcps}
    append_row(folder / "scenes.tsv", row)


def append_settings(folder: Path, lines: Sequence[str]) -> None:
    """More lines at the end of a new project's configuration."""
    with (folder / "config.yaml").open("a", encoding="utf-8") as stream:
        stream.write("\n" + "\n".join(lines) + "\n")


@dataclass(frozen=True)
class Options:
    """What ``stereotruth init --twin`` is told besides the file; see its help."""

    crs: str = ""
    density: float = DENSITY
    sun_deg: tuple[float, float] = SUN_DEG
    size_px: tuple[int, int] | None = None
    rpcs: tuple[Path, Path] | None = None


def with_twin(folder: str | Path, file: Path, options: Options) -> str:
    """A new project whose city is the twin of the place of a LAS or LAZ file; the next step.

    Raises InputError: no such file, none of points, no coordinate system, options out of bounds.
    """
    low, high = DENSITIES
    if not low <= options.density <= high:
        raise InputError(
            f"{options.density:g} points per m²", remedy=f"--density takes {low:g} to {high:g}"
        )
    if not 15 <= options.sun_deg[1] <= 90:
        raise InputError(
            f"a sun {options.sun_deg[1]:g} degrees high",
            remedy="--sun takes azimuth and elevation, 15 to 90 degrees high",
        )
    city = twin_city(
        NAME,
        file.resolve(),
        crs=options.crs,
        size_px=options.size_px,
        sun_deg=options.sun_deg,
        rpcs=None if options.rpcs is None else tuple(rpc.resolve() for rpc in options.rpcs),
    )
    (scene,) = city.scenes
    shorter = min(scene.cols, scene.rows)
    if shorter < LEAST_PX:
        raise InputError(
            f"the left image would have {scene.cols} x {scene.rows} px of {LEFT_GSD_M} m",
            file=file,
            remedy=f"name a place of {LEAST_PX * LEFT_GSD_M:.0f} m or more, or a greater --size",
        )
    begin(folder)
    folder = Path(folder)
    write_city(city, folder / file_of(NAME))
    data = file_of(NAME).parent / scene.name
    _append_scene(folder, scene.name, NAME, data, data / "gcps.csv")
    append_row(folder / "cities.tsv", city_row(NAME, PREFIX))
    side = next(n for n in (1024, 512, 256, 128) if n <= shorter * 0.6 or n == 128)
    append_settings(
        folder,
        ["simulate:", f"  lidar_spacing_m: {options.density**-0.5:.3g} # {options.density:g} points"
         " per m²", "tiles:", f"  size: {side}"],
    )  # fmt: skip
    return f"stereotruth run tiles/{NAME} evaluate report"
