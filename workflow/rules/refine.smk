rule refine:
    input:
        left=left_image,
        right=right_image,
        left_mask=given_in("left_mask"),
        right_mask=given_in("right_mask"),
        alignment=rules.align.output.alignment,
        points=point_stores,
    output:
        alignment="results/refine/{city}/{scene}/alignment.json",
        observations=report(
            "results/refine/{city}/{scene}/observations.csv",
            caption="../report/refinement.rst",
            category="Alignment",
            labels={"scene": "{scene}", "kind": "tie points of the refinement"},
        ),
        equations="results/refine/{city}/{scene}/equations.json",
    log:
        "logs/refine/{city}/{scene}.log",
    benchmark:
        "logs/refine/{city}/{scene}.tsv"
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("refine"),
        strict=SETTINGS.strict,
        alone=lambda wildcards: wildcards.scene not in ADJUSTED,
        bands=SETTINGS.rectify.model_dump(),
        code=source_digest("stereotruth.align.refine", "stereotruth.align.records"),
    message:
        "Refining the alignment of scene {wildcards.scene} by LiDAR and images"
    script:
        "../scripts/refine.py"


rule draw_refinement:
    input:
        left=left_image,
        alignment=rules.refine.output.alignment,
        observations=rules.refine.output.observations,
    output:
        figure=report(
            "results/refine/{city}/{scene}/refinement.png",
            caption="../report/refinement.rst",
            category="Alignment",
            labels={"scene": "{scene}", "kind": "figure of the refinement"},
        ),
    log:
        "logs/draw_refinement/{city}/{scene}.log",
    benchmark:
        "logs/draw_refinement/{city}/{scene}.tsv"
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("draw_refinement"),
        code=source_digest("stereotruth.align.figures"),
    message:
        "Drawing the tie points of scene {wildcards.scene}"
    script:
        "../scripts/draw_refinement.py"
