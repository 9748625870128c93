rule project:
    input:
        left=rules.rectify.output.left,
        right=rules.rectify.output.right,
        points=point_stores,
    output:
        disparity=directory("results/project/{city}/{scene}.zarr"),
    log:
        "logs/project/{city}/{scene}.log",
    benchmark:
        "benchmarks/project/{city}/{scene}.tsv"
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        view="left",
        occlusion=config["occlusion"],
        project={key: v for key, v in config["project"].items() if key != "right_view"},
        code=source_digest("disparity"),
    message:
        "Projecting the point cloud of scene {wildcards.scene}"
    script:
        "../scripts/project.py"


use rule project as project_right with:
    output:
        disparity=directory("results/project/{city}/{scene}_right.zarr"),
    log:
        "logs/project_right/{city}/{scene}.log",
    benchmark:
        "benchmarks/project_right/{city}/{scene}.tsv"
    params:
        view="right",
        occlusion=config["occlusion"],
        project={key: v for key, v in config["project"].items() if key != "right_view"},
        code=source_digest("disparity"),
    message:
        "Projecting the point cloud of scene {wildcards.scene} into the right view"
