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
    conda:
        CONDA
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
        code=source_digest("stereotruth.align.align", "stereotruth.align.align_report"),
    message:
        "Aligning scene {wildcards.scene} to its ground control points"
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
    conda:
        CONDA
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("draw_residuals"),
        code=source_digest("stereotruth.align.align_figure"),
    message:
        "Drawing the residuals of scene {wildcards.scene}"
    script:
        "../scripts/draw_residuals.py"


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
    conda:
        CONDA
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("refine"),
        strict=SETTINGS.strict,
        alone=lambda wildcards: wildcards.scene not in ADJUSTED,
        bands=SETTINGS.rectify.model_dump(),
        code=source_digest(
            "stereotruth.align.refine",
            "stereotruth.align.refine_report",
            "stereotruth.align.tie_equations",
        ),
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
    conda:
        CONDA
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("draw_refinement"),
        code=source_digest("stereotruth.align.refine_figure"),
    message:
        "Drawing the tie points of scene {wildcards.scene}"
    script:
        "../scripts/draw_refinement.py"


rule adjust:
    input:
        alignments=of_adjusted_pairs("results/refine/{city}/{scene}/alignment.json"),
        equations=of_adjusted_pairs("results/refine/{city}/{scene}/equations.json"),
        gcps=gcps_of_adjusted,
        fixed=lambda w: [given(f) for f in dict.fromkeys(fixed_images(w).values())],
    output:
        "results/adjust/{city}.json",
    log:
        "logs/adjust/{city}.log",
    benchmark:
        "logs/adjust/{city}.tsv"
    conda:
        CONDA
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("adjust"),
        pairs=lambda w: {s: [*ADJUSTED[s], SCENES[s].gcps] for s in adjusted_pairs(w.city)},
        fixed=lambda w: fixed_images(w),
        strict=SETTINGS.strict,
        epoch=lambda w: epoch_of(w.city),
        code=source_digest("stereotruth.align.site_adjustment"),
    message:
        "Adjusting the images of {wildcards.city} together"
    script:
        "../scripts/adjust.py"


rule adjusted_alignment:
    input:
        site=adjustment_of,
        alignment="results/refine/{city}/{scene}/alignment.json",
        equations="results/refine/{city}/{scene}/equations.json",
    output:
        "results/adjust/{city}/{scene}/alignment.json",
    log:
        "logs/adjusted_alignment/{city}/{scene}.log",
    benchmark:
        "logs/adjusted_alignment/{city}/{scene}.tsv"
    conda:
        CONDA
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("adjusted_alignment"),
        images=lambda w: ADJUSTED[w.scene],
        code=source_digest("stereotruth.align.site_pair"),
    message:
        "Alignment of scene {wildcards.scene} by its adjusted images"
    script:
        "../scripts/adjusted_alignment.py"
