rule ingest:
    input:
        lidar=lambda w: given(LIDAR[w.scene][w.lidar]),
        geoid=given_in("geoid"),
    output:
        store=directory("results/ingest/{city}/{scene}/{lidar}.points"),
    log:
        "logs/ingest/{city}/{scene}/{lidar}.log",
    benchmark:
        "logs/ingest/{city}/{scene}/{lidar}.tsv"
    conda:
        CONDA
    resources:
        mem_mb=2000,
        runtime=60,
        copies_gb=str(SETTINGS.ingest.copies_gb),
    params:
        sources=upstream("ingest"),
        lidar_crs=lambda w: SCENES[w.scene].lidar_crs,
        lidar_epoch=lambda w: epoch_year(SCENES[w.scene].lidar_epoch),
        epoch=lambda w: epoch_of(w.city),
        acquired=lambda w: ACQUIRED.get(str(LIDAR[w.scene][w.lidar]), []),
        drop_classes=sorted(SETTINGS.ingest.drop_classes),
        footprint=lambda w: ground_of_stores(w.scene),
        code=source_digest("stereotruth.lidar.ingest"),
    message:
        "Reading LiDAR file {wildcards.lidar} of scene {wildcards.scene}"
    script:
        "../scripts/ingest.py"


rule compare_strips:
    input:
        points=point_stores_as_read,
    output:
        strips=directory("results/strips/{city}/{scene}.strips"),
    log:
        "logs/compare_strips/{city}/{scene}.log",
    benchmark:
        "logs/compare_strips/{city}/{scene}.tsv"
    conda:
        CONDA
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
    wildcard_constraints:
        origin="|".join(SCENES),
    conda:
        CONDA
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        sources=upstream("move_strips"),
        code=source_digest("stereotruth.lidar.strip_moves"),
    message:
        "Moving the points of {wildcards.lidar} by the offsets of their strips"
    script:
        "../scripts/move_strips.py"


rule surface:
    input:
        images=images_of_surface,
        beside=beside_images_of_surface,
        points=point_stores,
    output:
        surface=directory("results/surface/{city}/{scene}.surface"),
    log:
        "logs/surface/{city}/{scene}.log",
    benchmark:
        "logs/surface/{city}/{scene}.tsv"
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        sources=upstream("surface"),
        code=source_digest("stereotruth.surface.make_surface", "stereotruth.sensor.shown_ground"),
    message:
        "Making the surface of the points of scene {wildcards.scene}"
    script:
        "../scripts/surface.py"
