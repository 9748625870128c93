"""Input functions: which files a stage takes of a scene or a city."""

from stereotruth.epipolar.image_files import files_beside


def given(path):
    """A file that users give: it lies here, also where the products go to object storage."""
    return local(str(path))


def with_files_beside(scene, view):
    """An image of a scene, and all that is read with it and with its mask: edits are seen."""
    image, mask = getattr(scene, f"{view}_image"), getattr(scene, f"{view}_mask")
    if is_synthetic(scene):
        return [str(image)]
    beside = [file for of in (image, mask) if of for file in files_beside(of)]
    return [given(file) for file in (image, *dict.fromkeys(beside))]


def left_image(wildcards):
    return with_files_beside(SCENES[wildcards.scene], "left")


def right_image(wildcards):
    return with_files_beside(SCENES[wildcards.scene], "right")


def given_in(column):
    """Input function: the file that a scene's row names in a column, if it names one."""

    def file_of(wildcards):
        path = getattr(SCENES[wildcards.scene], column)
        return given(path) if path else []

    return file_of


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


def adjusted_pairs(city):
    """The scenes of a city whose images are adjusted together, by name."""
    return sorted(scene for scene in ADJUSTED if SCENES[scene].city == city)


def of_adjusted_pairs(file):
    """Input function: a file of each scene of a city whose images are adjusted together."""

    def files_of(wildcards):
        return [
            file.format(city=wildcards.city, scene=scene)
            for scene in adjusted_pairs(wildcards.city)
        ]

    return files_of


def gcps_of_adjusted(wildcards):
    """The control points of all images that are adjusted together, each file once."""
    files = [SCENES[scene].gcps for scene in adjusted_pairs(wildcards.city)]
    return [given(file) for file in dict.fromkeys(filter(None, files))]


def fixed_images(wildcards):
    """Files of ``alignment.fixed`` by image of a city that is adjusted with others."""
    images = {name for scene in adjusted_pairs(wildcards.city) for name in ADJUSTED[scene]}
    return {k: v for k, v in SETTINGS.alignment.fixed.items() if k in images}


def strips_made(wildcards, file):
    """The files that tell that the strips of a scene are made; none if one job makes it all."""
    strips = SETTINGS.strips
    count = strips if isinstance(strips, int) else strips.get(wildcards.scene, 1)
    names = [f"{k}-of-{count}" for k in range(count)] if count > 1 else []
    return expand(file, **wildcards, strip=names)


def truth_of_city(city, kind):
    """The city's figures against the exact truth (json, csv), if it has synthetic scenes."""
    return [f"results/evaluate/{city}/truth.{kind}"] if synthetic_scenes(city) else []


def lidar_file(wildcards):
    scene, file = SCENES[wildcards.scene], LIDAR[wildcards.scene][wildcards.lidar]
    return str(file) if is_synthetic(scene) else given(file)


def point_stores(wildcards):
    """The points of a scene; files that another scene of the city reads, too, are read once."""
    return [
        f"results/ingest/{wildcards.city}/{scene}/{lidar}.points"
        for scene, lidar in STORES[wildcards.scene]
    ]


def scene_of_image(image):
    """(scene, view) that an image's correction is taken of: the first scene by name."""
    for scene, names in sorted(IMAGE_NAMES.items()):
        if image in names:
            return SCENES[scene], ("left", "right")[names.index(image)]
    raise WorkflowError(
        f"{SETTINGS.scenes}: no scene names image {image!r}, so that it has no correction. "
        "Remedy: stereotruth pairs CITY writes rows of pairs"
    )


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
