"""A project whose city is the twin of a real place: its sheets, settings and city.json."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stereocities.cities import LEFT_GSD_M, file_of, write_city
from stereocities.twin_world import SUN_DEG, twin_city

from ..core.errors import InputError
from .example_city import append_row, append_settings, city_row
from .new_project import begin

NAME, PREFIX = "Twin", "TW"
LEAST_PX = 256  # of the left image's shorter side: fewer have no tile
DENSITY = 1 / 0.4**2  # points per m², that of the six cities
DENSITIES = 0.04, 100.0  # points per m², what simulate.lidar_spacing_m can be


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
    row = {
        "scene": scene.name,
        "city": NAME,
        "left_image": data / "left.tif",
        "right_image": data / "right.tif",
        "lidar": data / "lidar",
        "gcps": data / "gcps.csv",
    }
    append_row(folder / "scenes.tsv", row)
    append_row(folder / "cities.tsv", city_row(NAME, PREFIX))
    side = next(n for n in (1024, 512, 256, 128) if n <= shorter * 0.6 or n == 128)
    append_settings(
        folder,
        ["simulate:", f"  lidar_spacing_m: {options.density**-0.5:.3g} # {options.density:g} points"
         " per m²", "tiles:", f"  size: {side}"],
    )  # fmt: skip
    return f"stereotruth run tiles/{NAME} evaluate report"
