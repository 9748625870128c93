rule evaluate_images:
    input:
        tiles="tiles/{city}",
        matches="results/export/{city}/matches.csv",
        left=lambda w: [f"results/rectify/{w.city}/{s.scene}/left.zarr" for s in scenes_of(w.city)],
        right=lambda w: [
            f"results/rectify/{w.city}/{s.scene}/right.zarr" for s in scenes_of(w.city)
        ],
        disparity=lambda w: [f"results/project/{w.city}/{s.scene}.zarr" for s in scenes_of(w.city)],
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
    conda:
        CONDA
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("evaluate_images"),
        script=content_of("../scripts/evaluate_images.py"),
        scenes=lambda w: [s.scene for s in scenes_of(w.city)],
        code=source_digest("stereotruth.evaluate.labels_against_images"),
    message:
        "Holding the labels of {wildcards.city} against the images"
    script:
        "../scripts/evaluate_images.py"
