"""The images of a site that share ground, corrected together: same image, same correction."""


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
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        sources=upstream("adjusted_alignment"),
        images=lambda w: ADJUSTED[w.scene],
        code=source_digest("stereotruth.align.records"),
    message:
        "Alignment of scene {wildcards.scene} by its adjusted images"
    script:
        "../scripts/adjusted_alignment.py"
