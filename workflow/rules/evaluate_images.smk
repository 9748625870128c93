rule evaluate_images:
    input:
        tiles="tiles/{city}",
        matches="results/export/{city}/matches.csv",
        left=of_scenes("results/rectify/{city}/{scene}/left.zarr"),
        right=of_scenes("results/rectify/{city}/{scene}/right.zarr"),
        disparity=of_scenes("results/project/{city}/{scene}.zarr"),
    output:
        table4=report(
            "results/evaluate/{city}/table4.csv",
            caption="../report/table4.rst",
            category="Images against labels",
            labels={"city": "{city}", "kind": "SIFT, table 4"},
        ),
        sift="results/evaluate/{city}/sift.csv",
        warping=report(
            "results/evaluate/{city}/warping.csv",
            caption="../report/warping.rst",
            category="Images against labels",
            labels={"city": "{city}", "kind": "image warping, table"},
        ),
        sift_figure=report(
            "results/evaluate/{city}/sift.png",
            caption="../report/sift.rst",
            category="Images against labels",
            labels={"city": "{city}", "kind": "SIFT errors"},
        ),
        warping_figure=report(
            "results/evaluate/{city}/warping.png",
            caption="../report/warping.rst",
            category="Images against labels",
            labels={"city": "{city}", "kind": "image warping"},
        ),
    log:
        "logs/evaluate_images/{city}.log",
    benchmark:
        "logs/evaluate_images/{city}.tsv"
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("evaluate_images"),
        scenes=lambda w: [s.scene for s in scenes_of(w.city)],
        code=source_digest("stereotruth.evaluate.labels_against_images"),
    message:
        "Holding the labels of {wildcards.city} against the images"
    script:
        "../scripts/evaluate_images.py"
