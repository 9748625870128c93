rule rectify:
    input:
        left=left_image,
        right=right_image,
        alignment=alignment_of,
    output:
        epipolar="results/rectify/{city}/{scene}/epipolar.json",
        left=directory("results/rectify/{city}/{scene}/left.zarr"),
        right=directory("results/rectify/{city}/{scene}/right.zarr"),
    log:
        "logs/rectify/{city}/{scene}.log",
    benchmark:
        "benchmarks/rectify/{city}/{scene}.tsv"
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=2000,
        runtime=120,
    params:
        code=source_digest("rectification", "alignment"),
    message:
        "Making epipolar images of scene {wildcards.scene}"
    script:
        "../scripts/rectify.py"
