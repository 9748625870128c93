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
        occlusion=config["occlusion"],
        project=config["project"],
        code=source_digest("disparity"),
    message:
        "Projecting the point cloud of scene {wildcards.scene}"
    script:
        "../scripts/project.py"
