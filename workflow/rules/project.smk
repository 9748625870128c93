PROJECTION = SETTINGS.project.model_dump(exclude={"right_view"})


rule project:
    input:
        left=rules.rectify.output.left,
        right=rules.rectify.output.right,
        alignment=alignment_of,
        points=point_stores,
        surface=surface_of_labels,
        lidar_strips=strips_of,
        strips=lambda w: strips_made(w, "results/project/{city}/strips/{scene}{side}_{strip}.json"),
    output:
        disparity=directory("results/project/{city}/{scene}{side}.zarr"),
    log:
        "logs/project/{city}/{scene}{side}.log",
    benchmark:
        "logs/project/{city}/{scene}{side}.tsv"
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
        dask=SETTINGS.dask.scheduler_address or "",
    params:
        sources=upstream("project"),
        view=lambda w: "right" if w.side else "left",
        settings=PROJECTION,
        light=lambda w: light_of(w.scene),
        code=source_digest("stereotruth.labels.project"),
    message:
        "Projecting the point cloud of scene {wildcards.scene}{wildcards.side}"
    script:
        "../scripts/project.py"


use rule project as project_strip with:
    input:
        left=rules.rectify.output.left,
        right=rules.rectify.output.right,
        alignment=alignment_of,
        points=point_stores,
        surface=surface_of_labels,
        lidar_strips=strips_of,
    output:
        done=temp("results/project/{city}/strips/{scene}{side}_{strip}.json"),
    log:
        "logs/project_strip/{city}/{scene}{side}_{strip}.log",
    benchmark:
        "logs/project_strip/{city}/{scene}{side}_{strip}.tsv"
    resources:
        mem_mb=4000,
        runtime=120,
        dask="",
    params:
        sources=upstream("project_strip", "project"),
        view=lambda w: "right" if w.side else "left",
        store="results/project/{city}/{scene}{side}.zarr",
        settings=PROJECTION,
        light=lambda w: light_of(w.scene),
        code=source_digest("stereotruth.labels.project"),
    message:
        "Projecting strip {wildcards.strip} of scene {wildcards.scene}{wildcards.side}"
