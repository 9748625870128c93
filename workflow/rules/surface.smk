"""The surface of the points, made once for all pairs that take the same LiDAR."""


rule surface:
    input:
        images=images_of_surface,
        beside=beside_images_of_surface,
        points=point_stores,
        strips=lambda w: strips_made(
            w, "results/surface/{city}/strips/{scene}_{strip}.json", scenes_of_surface(w)
        ),
    output:
        surface=directory("results/surface/{city}/{scene}.surface"),
    log:
        "logs/surface/{city}/{scene}.log",
    benchmark:
        "logs/surface/{city}/{scene}.tsv"
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        sources=upstream("surface"),
        code=source_digest("stereotruth.surface.make_surface", "stereotruth.sensor.pair_geometry"),
    message:
        "Making the surface of the points of scene {wildcards.scene}"
    script:
        "../scripts/surface.py"


use rule surface as surface_strip with:
    input:
        images=images_of_surface,
        beside=beside_images_of_surface,
        points=point_stores,
    output:
        done=temp("results/surface/{city}/strips/{scene}_{strip}.json"),
    log:
        "logs/surface_strip/{city}/{scene}_{strip}.log",
    benchmark:
        "logs/surface_strip/{city}/{scene}_{strip}.tsv"
    resources:
        mem_mb=4000,
        runtime=120,
    params:
        sources=upstream("surface_strip", "surface"),
        store="results/surface/{city}/{scene}.surface",
        code=source_digest("stereotruth.surface.make_surface", "stereotruth.sensor.pair_geometry"),
    message:
        "Making strip {wildcards.strip} of the surface of the points of scene {wildcards.scene}"
