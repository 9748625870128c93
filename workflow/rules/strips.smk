"""Strips of the LiDAR: what they are off, and points moved by that where this is asked for."""


rule compare_strips:
    input:
        points=point_stores_as_read,
    output:
        strips=directory("results/strips/{city}/{scene}.strips"),
    log:
        "logs/compare_strips/{city}/{scene}.log",
    benchmark:
        "logs/compare_strips/{city}/{scene}.tsv"
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        sources=upstream("compare_strips"),
        taken_out=SETTINGS.ingest.strips == "adjusted",
        code=source_digest("stereotruth.lidar.strip_comparison"),
    message:
        "Comparing the strips of the LiDAR of scene {wildcards.scene}"
    script:
        "../scripts/compare_strips.py"


rule move_strips:
    input:
        points="results/ingest/{city}/{origin}/{lidar}.points",
        strips=rules.compare_strips.output.strips,
    output:
        store=directory("results/strips/{city}/{scene}/{origin}/{lidar}.points"),
    log:
        "logs/move_strips/{city}/{scene}/{origin}/{lidar}.log",
    benchmark:
        "logs/move_strips/{city}/{scene}/{origin}/{lidar}.tsv"
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        sources=upstream("move_strips"),
        code=source_digest("stereotruth.lidar.strips"),
    message:
        "Moving the points of {wildcards.lidar} by the offsets of their strips"
    script:
        "../scripts/move_strips.py"
