"""Input functions: which files a stage takes of a scene or a city."""


def with_rpc_files(image):
    """An image and the RPC files beside it, so that an edited RPC is seen."""
    image = Path(image)
    beside = [image.with_suffix(s) for s in (".RPB", ".rpb")]
    beside += [image.with_name(f"{image.stem}{s}") for s in ("_RPC.TXT", "_rpc.txt", "_RPC.txt")]
    beside += sorted(image.parent.glob("RPC_*.XML"))  # of DIMAP, both views'
    return [str(image), *(str(file) for file in beside if file.is_file())]


def left_image(wildcards):
    return with_rpc_files(SCENES[wildcards.scene].left_image)


def right_image(wildcards):
    return with_rpc_files(SCENES[wildcards.scene].right_image)


def left_mask(wildcards):
    return SCENES[wildcards.scene].left_mask or []


def right_mask(wildcards):
    return SCENES[wildcards.scene].right_mask or []


def alignment_of(wildcards):
    """The alignment that the scene's rectified images and labels are made with."""
    if given := SETTINGS.alignment.fixed.get(wildcards.scene):
        return given
    stage = "refine" if SETTINGS.alignment.refine else "align"
    return f"results/{stage}/{wildcards.city}/{wildcards.scene}/alignment.json"


def refinements(wildcards):
    """The alignments that a city's labels are made with, where they are not those of rule align."""
    files = [alignment_of(scene) for scene in scenes_of(wildcards.city)]
    return [file for file in files if file.startswith("results/refine/")]


def strips_made(wildcards, file):
    """The files that tell that the strips of a scene are made; none if one job makes it all."""
    strips = SETTINGS.strips
    count = strips if isinstance(strips, int) else strips.get(wildcards.scene, 1)
    names = [f"{k}-of-{count}" for k in range(count)] if count > 1 else []
    return expand(file, **wildcards, strip=names)


def truth_of_city(city, kind):
    """The city's figures against the exact truth (json, csv), if it has synthetic scenes."""
    return [f"results/evaluate/{city}/truth.{kind}"] if synthetic_scenes(city) else []


def point_stores(wildcards):
    return expand(
        "results/ingest/{city}/{scene}/{lidar}.zarr",
        city=wildcards.city,
        scene=wildcards.scene,
        lidar=LIDAR[wildcards.scene],
    )


def cities_of_report():
    """All of a configuration that somebody named; of the examples, those that have tiles.

    Who forgets --configfile asks for none of the synthetic cities.
    """
    examples = Path(SETTINGS.cities).match("config/cities.tsv")
    if workflow.overwrite_configfiles or not examples:
        return list(CITIES)
    if made := [city for city in CITIES if Path(f"tiles/{city}").is_dir()]:
        return made
    raise WorkflowError(
        f"{SETTINGS.cities}: no city of it has tiles to report on. Remedy: add --configfile FILE "
        "if it was forgotten; or make tiles first (snakemake --cores 2 tiles/<City>), or ask for "
        "all these cities by --configfile config/config.yaml"
    )
