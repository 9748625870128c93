"""Input functions: which files a stage takes of a scene or a city."""

from functools import cache

from stereotruth.core.config.configuration import NEEDED
from stereotruth.core.errors import InputError, require_packages
from stereotruth.sensor.deliveries import files_beside


def with_files_beside(scene, view):
    """An image of a scene, and all that is read with it and with its mask: edits are seen."""
    image, mask = getattr(scene, f"{view}_image"), getattr(scene, f"{view}_mask")
    if is_synthetic(scene):
        return [given(image)]
    beside = [file for of in (image, mask) if of for file in files_beside(of)]
    return [given(file) for file in (image, *dict.fromkeys(beside))]


def file_of_city(wildcards):
    """The file of a synthetic city of the project's own; none of the six has one."""
    file = cities.file_of(wildcards.city)
    return [given(file)] if file.is_file() else []


def files_of_place(wildcards):
    """The files of the real place that a synthetic city is the twin of."""
    city = cities.synthetic_city(wildcards.city)
    return [given(file) for file in city.twin.files] if city and city.twin else []


def left_image(wildcards):
    return with_files_beside(SCENES[wildcards.scene], "left")


def right_image(wildcards):
    return with_files_beside(SCENES[wildcards.scene], "right")


def given_in(column):
    """Input function: the file that a scene's row names in a column, if it names one."""
    return lambda w: given(path) if (path := getattr(SCENES[w.scene], column)) else []


def alignment_of(wildcards):
    """The alignment that the scene's rectified images and labels are made with."""
    if fixed := SETTINGS.alignment.fixed.get(wildcards.scene):
        return given(fixed)
    if wildcards.scene in ADJUSTED:
        return f"results/adjust/{wildcards.city}/{wildcards.scene}/alignment.json"
    stage = "refine" if SETTINGS.alignment.refine else "align"
    return f"results/{stage}/{wildcards.city}/{wildcards.scene}/alignment.json"


def refinements(wildcards):
    """The alignments that a city's labels are made with, where they are not those of rule align."""
    files = [alignment_of(scene) for scene in scenes_of(wildcards.city)]
    return [file for file in files if file.startswith(("results/refine/", "results/adjust/"))]


def refinement_figures(wildcards):
    """The figures of the refinements of a city's scenes, each by its own tie points."""
    return [
        f"results/refine/{scene.city}/{scene.scene}/refinement.png"
        for scene in scenes_of(wildcards.city)
        if SETTINGS.alignment.refine and scene.scene not in SETTINGS.alignment.fixed
    ]


def of_scenes(file):
    """Input function: a file of each scene of a city."""
    return lambda w: [file.format(city=w.city, scene=s.scene) for s in scenes_of(w.city)]


def of_synthetic(file):
    """Input function: a file of a city, if it has synthetic scenes."""
    return lambda w: [file.format(city=w.city)] if synthetic_scenes(w.city) else []


def of_adjusted(file):
    """Input function: a file of a city, if images of it are adjusted together."""
    return lambda w: [file.format(city=w.city)] if adjusted_pairs(w.city) else []


def adjusted_pairs(city):
    """The scenes of a city whose images are adjusted together, by name."""
    return sorted(scene for scene in ADJUSTED if SCENES[scene].city == city)


def of_adjusted_pairs(file):
    """Input function: a file of each scene of a city whose images are adjusted together."""
    return lambda w: [file.format(city=w.city, scene=scene) for scene in adjusted_pairs(w.city)]


def gcps_of_adjusted(wildcards):
    """The control points of all images that are adjusted together, each file once."""
    files = [SCENES[scene].gcps for scene in adjusted_pairs(wildcards.city)]
    return [given(file) for file in dict.fromkeys(filter(None, files))]


def fixed_images(wildcards):
    """Files of ``alignment.fixed`` by image of a city that is adjusted with others."""
    images = {name for scene in adjusted_pairs(wildcards.city) for name in ADJUSTED[scene]}
    return {k: v for k, v in SETTINGS.alignment.fixed.items() if k in images}


def strips_made(wildcards, file, scenes=None):
    """The files that tell that the strips of a scene are made; none if one job makes it all.

    ``scenes``: all that have the product in common, of which the most strips count.
    """
    strips = SETTINGS.strips
    if not isinstance(strips, int):
        strips = max(strips.get(scene, 1) for scene in scenes or [wildcards.scene])
    count = strips
    names = [f"{k}-of-{count}" for k in range(count)] if count > 1 else []
    return expand(file, **wildcards, strip=names)


@cache
def ground_of_stores(scene):
    """The ground whose points a scene's own stores have: runs of cells, None for all points.

    It is that of all scenes that take points of them. Cities that are made have no images yet when
    their points are planned.
    """
    from stereotruth.align.images import footprint_of  # for few jobs

    margin_m = SETTINGS.ingest.margin_m
    if margin_m is None or is_synthetic(SCENES[scene]):
        return None
    takers = [SCENES[name] for name, stores in STORES.items() if scene in dict(stores)]
    found = footprint_of([(of.left_image, of.right_image) for of in takers], margin_m)
    return None if found is None else found.runs


@cache
def epoch_of(city):
    """The epoch of a city's places: decimal year, and what tells it."""
    return list(epoch_of_city(CITIES[city], SCENES, IMAGES))


def paths_of_stores(city, stores):
    """Paths of point stores by their (scene, name)."""
    return [f"results/ingest/{city}/{scene}/{lidar}.points" for scene, lidar in stores]


def point_stores_as_read(wildcards):
    """The points of a scene; files that another scene of the city reads, too, are read once."""
    return paths_of_stores(wildcards.city, STORES[wildcards.scene])


def point_stores(wildcards):
    """The points of a scene, moved by the offsets of their strips where this is asked for."""
    if SETTINGS.ingest.strips != "adjusted":
        return point_stores_as_read(wildcards)
    city, scene = wildcards.city, wildcards.scene
    return [
        f"results/strips/{city}/{SURFACES[scene]}/{origin}/{lidar}.points"
        for origin, lidar in STORES[scene]
    ]


def strips_of(wildcards):
    """What the strips of a scene's points are off, found once for all scenes that take the same."""
    return f"results/strips/{wildcards.city}/{SURFACES[wildcards.scene]}.strips"


def point_stores_of_city(wildcards):
    """The points of all scenes of a city, each store once."""
    stores = [store for of in scenes_of(wildcards.city) for store in STORES[of.scene]]
    return paths_of_stores(wildcards.city, dict.fromkeys(stores))


def scenes_of_surface(wildcards):
    """Names of the scenes that a surface is for: those that take the same points."""
    return [scene for scene, first in SURFACES.items() if first == wildcards.scene]


def images_of_surface(wildcards):
    """The images that the surface of some points is for, each once."""
    scenes = [SCENES[scene] for scene in scenes_of_surface(wildcards)]
    images = (image for scene in scenes for image in (scene.left_image, scene.right_image))
    return [given(image) for image in dict.fromkeys(images)]


def beside_images_of_surface(wildcards):
    """What is read with these images, as their RPCs."""
    files = [file for image in images_of_surface(wildcards) for file in files_beside(image)]
    return [given(file) for file in dict.fromkeys(files)]


def surface_of(wildcards):
    """The surface of a scene's points, made once for all scenes that take the same points."""
    return f"results/surface/{wildcards.city}/{SURFACES[wildcards.scene]}.surface"


def surface_of_labels(wildcards):
    """The surface that a scene's labels follow from; the recipe paper needs none."""
    return surface_of(wildcards) if SETTINGS.project.recipe == "surface" else []


def adjustment_of(wildcards):
    """The adjustment that a scene's images have their corrections of: the fixed one of both."""
    fixed = {SETTINGS.alignment.fixed.get(image) for image in ADJUSTED[wildcards.scene]}
    if len(fixed) == 1 and None not in fixed:
        return given(fixed.pop())
    return f"results/adjust/{wildcards.city}.json"


def scene_of_image(image):
    """(scene, view) that an image's correction is taken of: the first scene by name."""
    for scene, names in sorted(IMAGE_NAMES.items()):
        if image in names:
            return SCENES[scene], ("left", "right")[names.index(image)]
    raise Refused(
        f"{SETTINGS.scenes}: no scene names image {image!r}, so that it has no correction. "
        "Remedy: stereotruth pairs CITY writes rows of pairs"
    )


def sheet_images(city):
    """The rows of the images sheet that are of a city, by name."""
    return {name: image for name, image in IMAGES.items() if image.city == city}


def files_of_sheet(wildcards):
    """The original images of a city's images sheet, and all that is read with them."""
    files = map(file_of_image, sheet_images(wildcards.city).values())
    return [given(file) for image in files for file in (image, *files_beside(image))]


def is_site(city):
    """Whether scenes of the city are pairs of its images sheet, so that it has a page of a site."""
    return any(all(IMAGE_NAMES[s.scene]) for s in SCENES.values() if s.city == city)


def closure_of(wildcards):
    """The closure of the city's triplets, if three of its pairs are one."""
    pairs = {tuple(ADJUSTED[scene]) for scene in adjusted_pairs(wildcards.city)}
    steps = ((a, c) for a, b in pairs for other, c in pairs if b == other)
    return [f"results/closure/{wildcards.city}.json"] if pairs & set(steps) else []


def heights_of(city):
    """The heights of a city's original images, of those that have a name in the images sheet."""
    names = (name for scene in scenes_of(city) for name in IMAGE_NAMES[scene.scene])
    return [f"results/heights/{city}/{name}.zarr" for name in dict.fromkeys(names) if name]


def by_scene_of_image(wildcards, file):
    """What an input function gives for the scene that an image's correction is taken of."""
    scene, _ = scene_of_image(wildcards.image)
    return file(SimpleNamespace(city=scene.city, scene=scene.scene))


def cities_of_report():
    """All of a configuration that somebody named; of the examples, those that have tiles.

    Who forgets --configfile asks for none of the synthetic cities.
    """
    examples = Path(SETTINGS.cities).match("config/cities.tsv")
    if workflow.overwrite_configfiles or not examples:
        return list(CITIES)
    if made := [city for city in CITIES if Path(f"tiles/{city}").is_dir()]:
        return made
    raise Refused(
        f"{SETTINGS.cities}: no city of it has tiles to report on. Remedy: add --configfile FILE "
        "if it was forgotten; or make tiles first (snakemake --cores 2 tiles/<City>), or ask for "
        "all these cities by --configfile config/config.yaml"
    )


def tiles_of_dataset(wildcards):
    """All cities' tiles. Packages that are missing are told before a dataset that is there goes."""
    for asked in (*SETTINGS.dataset.catalogs, *SETTINGS.dataset.layouts):
        try:
            require_packages(f"dataset: {asked}", NEEDED.get(asked, ()), "catalog")
        except InputError as error:
            raise Refused(str(error))
    return expand("tiles/{city}", city=CITIES)


def light_of(scene):
    """What the sheets tell of the light of a scene's images (see SceneInputs.in_light)."""
    cell = SCENES[scene].diachronic
    cells = {view: cells_of(name) for view, name in zip(VIEWS, IMAGE_NAMES[scene])}
    return {"diachronic": cell == "true" if cell else None, "cells": cells}


def cells_of(name):
    """When and by which sun an image was taken, by its row of the images sheet, if it has one."""
    row = IMAGES.get(name)
    return (row.acquired, row.sun_azimuth, row.sun_elevation) if row else ("", None, None)
