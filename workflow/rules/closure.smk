"""Triplets of images: what the labels of three pairs say of each other, without truth."""


rule closure_of_site:
    input:
        disparity=of_adjusted_pairs("results/project/{city}/{scene}.zarr"),
        alignments=of_adjusted_pairs("results/adjust/{city}/{scene}/alignment.json"),
        equations=of_adjusted_pairs("results/refine/{city}/{scene}/equations.json"),
    output:
        "results/closure/{city}.json",
    log:
        "logs/closure_of_site/{city}.log",
    benchmark:
        "logs/closure_of_site/{city}.tsv"
    resources:
        mem_mb=3000,
        runtime=120,
    params:
        sources=upstream("closure_of_site"),
        pairs=lambda w: {s: ADJUSTED[s] for s in adjusted_pairs(w.city)},
        code=source_digest("stereotruth.evaluate.closure"),
    message:
        "Closing the triplets of {wildcards.city}"
    script:
        "../scripts/closure_of_site.py"


rule closure:
    input:
        [f"results/closure/{city}.json" for city in CITIES if adjusted_pairs(city)],
