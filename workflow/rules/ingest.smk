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
