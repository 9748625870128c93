PROJECTION = SETTINGS.project.model_dump(exclude={"right_view"})


rule project:
    input:
        left=rules.rectify.output.left,
        right=rules.rectify.output.right,
        alignment=alignment_of,
        points=point_stores,
        surface=surface_of_labels,
        lidar_strips=strips_of,
        strips=lambda w: strips_made(w, "results/project/{city}/strips/{scene}_{strip}.json"),
    output:
        disparity=directory("results/project/{city}/{scene}.zarr"),
    log:
        "logs/project/{city}/{scene}.log",
    benchmark:
        "logs/project/{city}/{scene}.tsv"
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
        dask=SETTINGS.dask.scheduler_address or "",
    params:
        sources=upstream("project"),
        script=content_of("../scripts/project.py"),
        view="left",
        settings=PROJECTION,
        light=lambda w: light_of(w.scene),
        code=source_digest("stereotruth.labels.project"),
    message:
        "Projecting the point cloud of scene {wildcards.scene}"
    script:
        "../scripts/project.py"


use rule project as project_right with:
    input:
        left=rules.rectify.output.left,
        right=rules.rectify.output.right,
        alignment=alignment_of,
        points=point_stores,
        surface=surface_of_labels,
        lidar_strips=strips_of,
        strips=lambda w: strips_made(w, "results/project/{city}/strips/{scene}_right_{strip}.json"),
    output:
        disparity=directory("results/project/{city}/{scene}_right.zarr"),
    log:
        "logs/project_right/{city}/{scene}.log",
    benchmark:
        "logs/project_right/{city}/{scene}.tsv"
    params:
        sources=upstream("project_right"),
        script=content_of("../scripts/project.py"),
        view="right",
        settings=PROJECTION,
        light=lambda w: light_of(w.scene),
        code=source_digest("stereotruth.labels.project"),
    message:
        "Projecting the point cloud of scene {wildcards.scene} into the right view"


rule project_strip:
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
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=4000,
        runtime=120,
    params:
        sources=upstream("project_strip"),
        script=content_of("../scripts/project_strip.py"),
        view=lambda w: "right" if w.side else "left",
        store="results/project/{city}/{scene}{side}.zarr",
        settings=PROJECTION,
        light=lambda w: light_of(w.scene),
        code=source_digest("stereotruth.labels.project"),
    message:
        "Projecting strip {wildcards.strip} of the point cloud of scene {wildcards.scene}"
    script:
        "../scripts/project_strip.py"
