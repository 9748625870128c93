"""Heights in the geometry of original images, of those that scenes name."""


rule image_heights:
    input:
        alignment=lambda w: by_scene_of_image(w, alignment_of),
        points=lambda w: by_scene_of_image(w, point_stores),
        surface=lambda w: by_scene_of_image(w, surface_of),
    output:
        heights=directory("results/heights/{city}/{image}.zarr"),
    log:
        "logs/image_heights/{city}/{image}.log",
    benchmark:
        "logs/image_heights/{city}/{image}.tsv"
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        sources=upstream("image_heights"),
        view=lambda w: scene_of_image(w.image)[1],
        code=source_digest("stereotruth.labels.image_heights"),
    message:
        "Heights of what image {wildcards.image} shows"
    script:
        "../scripts/image_heights.py"


rule heights:
    input:
        [
            file
            for city in dict.fromkeys(s.city for s in SCENES.values())
            for file in heights_of(city)
        ],
