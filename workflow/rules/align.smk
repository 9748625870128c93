rule align:
    input:
        left=left_image,
        right=right_image,
        gcps=given_in("gcps"),
    output:
        alignment="results/align/{city}/{scene}/alignment.json",
        residuals=report(
            "results/align/{city}/{scene}/residuals.csv",
            caption="../report/residuals.rst",
            category="Alignment",
            labels={"scene": "{scene}", "kind": "table"},
        ),
    log:
        "logs/align/{city}/{scene}.log",
    benchmark:
        "logs/align/{city}/{scene}.tsv"
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("align"),
        names=lambda wildcards: IMAGE_NAMES[wildcards.scene],
        model=SETTINGS.alignment.model,
        strict=SETTINGS.strict,
        epoch=lambda w: epoch_of(w.city),
        alone=lambda wildcards: wildcards.scene not in ADJUSTED,
        code=source_digest("stereotruth.align.align"),
    message:
        "Aligning scene {wildcards.scene} by its ground control points, or by RPCs alone"
    script:
        "../scripts/align.py"


rule draw_residuals:
    input:
        alignment=rules.align.output.alignment,
    output:
        figure=report(
            "results/align/{city}/{scene}/residuals.png",
            caption="../report/residuals.rst",
            category="Alignment",
            labels={"scene": "{scene}", "kind": "figure"},
        ),
    log:
        "logs/draw_residuals/{city}/{scene}.log",
    benchmark:
        "logs/draw_residuals/{city}/{scene}.tsv"
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("draw_residuals"),
        code=source_digest("stereotruth.align.figures"),
    message:
        "Drawing the residuals of scene {wildcards.scene}"
    script:
        "../scripts/draw_residuals.py"
