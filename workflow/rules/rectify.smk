rule rectify:
    input:
        left=left_image,
        right=right_image,
        left_mask=given_in("left_mask"),
        right_mask=given_in("right_mask"),
        alignment=alignment_of,
        strips=lambda w: strips_made(w, "results/rectify/{city}/{scene}/strips/{strip}.json"),
    output:
        epipolar="results/rectify/{city}/{scene}/epipolar.json",
        left=directory("results/rectify/{city}/{scene}/left.zarr"),
        right=directory("results/rectify/{city}/{scene}/right.zarr"),
    log:
        "logs/rectify/{city}/{scene}.log",
    benchmark:
        "logs/rectify/{city}/{scene}.tsv"
    threads: 2
    resources:
        mem_mb=2000,
        runtime=120,
    params:
        sources=upstream("rectify"),
        bands=SETTINGS.rectify.model_dump(),
        code=source_digest(
            "stereotruth.epipolar.rectify",
            "stereotruth.epipolar.fit",
            "stereotruth.align.alignment",
        ),
    message:
        "Making epipolar images of scene {wildcards.scene}"
    script:
        "../scripts/rectify.py"


use rule rectify as rectify_strip with:
    input:
        left=left_image,
        right=right_image,
        left_mask=given_in("left_mask"),
        right_mask=given_in("right_mask"),
        alignment=alignment_of,
    output:
        done=temp("results/rectify/{city}/{scene}/strips/{strip}.json"),
    log:
        "logs/rectify_strip/{city}/{scene}_{strip}.log",
    benchmark:
        "logs/rectify_strip/{city}/{scene}_{strip}.tsv"
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        sources=upstream("rectify_strip", "rectify"),
        stores=lambda w: [f"results/rectify/{w.city}/{w.scene}/{v}.zarr" for v in VIEWS],
        bands=SETTINGS.rectify.model_dump(),
        code=source_digest(
            "stereotruth.epipolar.rectify",
            "stereotruth.epipolar.fit",
            "stereotruth.align.alignment",
        ),
    message:
        "Making strip {wildcards.strip} of the epipolar images of scene {wildcards.scene}"
