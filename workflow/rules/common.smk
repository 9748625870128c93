"""Configuration and sheets, checked; wildcard constraints; what all stages share."""

from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.errors import InputError, in_words
from stereotruth.core.products.provenance import SOURCES, file_sha256, source_digest
from stereotruth.project.project import (
    adjusted_scenes,
    check_fixed,
    days_of_pair,
    epoch_of_city,
    file_of_image,
    is_synthetic,
    lidar_days,
    lidar_of,
    names_in_pair,
    read_images,
    read_scenes,
    stores_of,
    surfaces_of,
)
from stereotruth.core.tables import epoch_year
from stereocities import cities

VIEWS = ("left", "right")


def has_truth(scene):
    """Whether the exact truth of a scene can be made: its images were simulated, here or before."""
    of_project = cities.file_of(scene.city).is_file()
    simulated = cities.synthetic_city(scene.city).scenes if of_project else ()
    return is_synthetic(scene) or any(of.name == scene.scene for of in simulated)


def synthetic_scenes(city):
    """Names of a city's scenes with exact truth, in the order of the sheet."""
    return [s.scene for s in SCENES.values() if s.city == city and has_truth(s)]


try:
    SETTINGS = Configuration.of(config)
    CITIES, SCENES = read_scenes(SETTINGS, ask=workflow.is_main_process)
    IMAGES = read_images(SETTINGS, CITIES)
    IMAGE_NAMES = {name: names_in_pair(scene, IMAGES) for name, scene in SCENES.items()}
    ACQUIRED = lidar_days(SETTINGS)
    LIDAR = {name: lidar_of(scene, SETTINGS) for name, scene in SCENES.items()}
    STORES = stores_of(SCENES, LIDAR)
    SURFACES = surfaces_of(STORES)
    check_fixed(SETTINGS, SCENES, IMAGES)
    ADJUSTED = adjusted_scenes(SETTINGS, SCENES, IMAGE_NAMES)
except InputError as error:
    raise Refused(str(error))


wildcard_constraints:
    city="|".join(CITIES),
    scene="|".join(SCENES),
    view="left|right",
    side="|_right",
    strip="[0-9]+-of-[0-9]+",
    lidar="[^/]+",
    tile=r"[^/]+\.la[sz]",
    origin="|".join(SCENES),
    image="[A-Za-z0-9_-]+",
    number="[0-9]+",
    tiles="[1-9][0-9]*",
    dataset="[^/]+",
    method="[^/]+",


def no_scenes(sheet, what, remedy):
    """The error of a city that the sheets do not have, as where --configfile was forgotten."""
    given, here = map(Path, workflow.overwrite_configfiles), Path.cwd()
    given = [str(f.relative_to(here) if f.is_relative_to(here) else f) for f in given]
    if not given:
        remedy = f"add --configfile FILE if it was forgotten; or else {remedy}"
    own = "config/config.yaml" if Path("config/config.yaml").is_file() else "the defaults"
    read = ", ".join([own, *given])
    return Refused(f"{sheet}: no {what} (configuration: {read}). Remedy: {remedy}")


def scenes_of(city):
    """The scenes of a city, in the order of the sheet."""
    if city not in CITIES:
        remedy = f"take one of {', '.join(CITIES)}, or add a row"
        raise no_scenes(SETTINGS.cities, f"city {city!r}", remedy)
    found = [scene for scene in SCENES.values() if scene.city == city]
    if not found:
        raise no_scenes(SETTINGS.scenes, f"scene of city {city!r}", "add a row")
    return found


def templates_of(template):
    """Digests of a page's template and of what all pages share."""
    shared = sorted((SOURCES / "stereotruth/pages").glob("*.jinja"))
    return [file_sha256(file) for file in (SOURCES / template, *shared)]
