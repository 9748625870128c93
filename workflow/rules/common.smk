"""Configuration and sheets, checked; wildcard constraints; what all stages share."""

from dataclasses import asdict
from pathlib import Path

from snakemake.exceptions import WorkflowError

from stereotruth import sheets
from stereotruth.configuration import Configuration
from stereotruth.errors import InputError
from stereotruth.products.provenance import PACKAGE, file_sha256, source_digest
from stereotruth.products.publication import made_of
from stereotruth.simulate.cities import CITIES as SYNTHETIC, lidar_files as synthetic_lidar

CONDA = Path(workflow.basedir) / "envs" / "workflow.yaml"
SYNTHETIC_FOLDER = "data/synthetic"
VIEWS = ("left", "right")


def is_synthetic(scene):
    """Whether the scene's input is made by the rules of simulate.smk."""
    city = SYNTHETIC.get(scene.city)
    made_here = f"{SYNTHETIC_FOLDER}/{scene.city}/{scene.scene}"
    return city is not None and scene.left_image == f"{made_here}/left.tif"


def synthetic_scenes(city):
    """Names of a city's synthetic scenes, in the order of the sheet."""
    return [s.scene for s in SCENES.values() if s.city == city and is_synthetic(s)]


def read_sheets(settings):
    """Cities and scenes by name, and the LiDAR files of each scene by store name."""
    cities = sheets.read_cities(settings.cities)
    scenes = sheets.read_scenes(settings.scenes, cities)
    sheet, alignment = settings.scenes, settings.alignment
    lidar = {}
    for name, scene in scenes.items():
        if not scene.gcps and not (alignment.refine or name in alignment.fixed):
            raise InputError(
                f"scene {name!r} has no GCPs, and alignment.refine is false",
                file=sheet,
                remedy="name its file of ground control points, or set alignment.refine to true",
            )
        if is_synthetic(scene):
            sheets.require_files(scene, sheet, ["gcps"])
            tiles = synthetic_lidar(SYNTHETIC[scene.city], name)
            files = [Path(scene.lidar) / tile for tile in tiles]
        else:
            files = ["left_image", "right_image", "gcps", "geoid", "left_mask", "right_mask"]
            sheets.require_files(scene, sheet, files)
            files = sheets.find_lidar(scene, sheet)
        lidar[name] = sheets.store_names(files)
    for name, file in alignment.fixed.items():
        if name not in scenes or not Path(file).is_file():
            raise InputError(
                f"alignment.fixed: {name}: {file}: "
                + ("no such file" if name in scenes else "no such scene"),
                file=sheet,
                remedy="take a scene of the sheet, and the path of its alignment.json",
            )
    return cities, scenes, lidar


try:
    SETTINGS = Configuration.of(config)
    CITIES, SCENES, LIDAR = read_sheets(SETTINGS)
except InputError as error:
    raise WorkflowError(str(error))


wildcard_constraints:
    city="|".join(CITIES),
    scene="|".join(SCENES),
    view="left|right",
    side="|_right",
    strip="[0-9]+-of-[0-9]+",
    lidar="[^/]+",


def no_scenes(sheet, what, remedy):
    """The error of a city that the sheets do not have, as where --configfile was forgotten."""
    given, here = map(Path, workflow.overwrite_configfiles), Path.cwd()
    given = [str(f.relative_to(here) if f.is_relative_to(here) else f) for f in given]
    if not given:
        remedy = f"add --configfile FILE if it was forgotten; or else {remedy}"
    read = ", ".join(["config/config.yaml", *given])
    return WorkflowError(f"{sheet}: no {what} (configuration: {read}). Remedy: {remedy}")


def scenes_of(city):
    """The scenes of a city, in the order of the sheet."""
    if city not in CITIES:
        remedy = f"take one of {', '.join(CITIES)}, or add a row"
        raise no_scenes(SETTINGS.cities, f"city {city!r}", remedy)
    found = [scene for scene in SCENES.values() if scene.city == city]
    if not found:
        raise no_scenes(SETTINGS.scenes, f"scene of city {city!r}", "add a row")
    return found


def making_of(rule, wildcards):
    """What the making of a job's products is called; other than it was if they are stale."""
    return made_of(rule.output[0].format(**wildcards))
