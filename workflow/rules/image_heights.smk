"""Heights in the geometry of original images, of those that scenes name."""


def named_by(image):
    """(scene, view) that an image's correction is taken of: the first scene by name."""
    for scene, names in sorted(IMAGE_NAMES.items()):
        if image in names:
            return SCENES[scene], ("left", "right")[names.index(image)]
    raise WorkflowError(
        f"{SETTINGS.scenes}: no scene names image {image!r}, so that it has no correction. "
        "Remedy: stereotruth pairs CITY writes rows of pairs"
    )


def of_named_by(wildcards, file):
    scene, _ = named_by(wildcards.image)
    return file(SimpleNamespace(city=scene.city, scene=scene.scene))


rule image_heights:
    input:
        alignment=lambda w: of_named_by(w, alignment_of),
        points=lambda w: of_named_by(w, point_stores),
    output:
        heights=directory("results/heights/{city}/{image}.zarr"),
    log:
        "logs/image_heights/{city}/{image}.log",
    benchmark:
        "logs/image_heights/{city}/{image}.tsv"
    wildcard_constraints:
        image="[A-Za-z0-9_-]+",
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        script=content_of("../scripts/image_heights.py"),
        view=lambda w: named_by(w.image)[1],
        code=source_digest("disparity.image_heights"),
    message:
        "Heights of what image {wildcards.image} shows"
    script:
        "../scripts/image_heights.py"


rule heights:
    input:
        [
            f"results/heights/{scene.city}/{name}.zarr"
            for scene in SCENES.values()
            for name in dict.fromkeys(IMAGE_NAMES[scene.scene])
            if name
        ],
