rule export:
    input:
        alignment=lambda w: [alignment_of(s) for s in scenes_of(w.city)],
        left=of_scenes("results/rectify/{city}/{scene}/left.zarr"),
        right=of_scenes("results/rectify/{city}/{scene}/right.zarr"),
        disparity=of_scenes("results/project/{city}/{scene}.zarr"),
        disparity_of_right=(
            of_scenes("results/project/{city}/{scene}_right.zarr")
            if SETTINGS.project.right_view
            else []
        ),
    output:
        tiles=directory("tiles/{city}"),
        summary="results/export/{city}/summary.json",
        matches="results/export/{city}/matches.csv",
        ground_looks=directory("results/export/{city}/quick_looks"),
        coverage=report(
            "results/export/{city}/coverage.png",
            caption="../report/coverage.rst",
            category="Tiles",
            labels={"city": "{city}", "kind": "coverage"},
        ),
        contact_sheet=report(
            "results/export/{city}/contact_sheet.png",
            caption="../report/contact_sheet.rst",
            category="Tiles",
            labels={"city": "{city}", "kind": "contact sheet"},
        ),
    log:
        "logs/export/{city}.log",
    benchmark:
        "logs/export/{city}.tsv"
    wildcard_constraints:
        city="[^/]+",  # so that scenes_of can name the cities that there are
    threads: 2
    resources:
        mem_mb=4000,
        runtime=60,
    params:
        sources=upstream("export"),
        scenes=lambda w: [s.scene for s in scenes_of(w.city)],
        acquired=lambda w: [days_of_pair(IMAGE_NAMES[s.scene], IMAGES) for s in scenes_of(w.city)],
        city=lambda w: {k: v for k, v in asdict(CITIES[w.city]).items() if k != "epoch"},
        settings={
            **SETTINGS.tiles.model_dump(),
            **SETTINGS.evaluation.model_dump(),
            "quality": SETTINGS.quality.model_dump(),
            "seed": SETTINGS.seed,
            "strict": SETTINGS.strict,
        },
        code=source_digest(
            "stereotruth.tiles.export",
            "stereotruth.tiles.label_moves",
            "stereotruth.align.alignment",
        ),
    message:
        "Cutting the tiles of {wildcards.city}"
    script:
        "../scripts/export.py"


rule originals:
    input:
        tiles="tiles/{city}",
        left=lambda w: [with_files_beside(s, "left")[0] for s in scenes_of(w.city)],
        right=lambda w: [with_files_beside(s, "right")[0] for s in scenes_of(w.city)],
        heights=lambda w: heights_of(w.city) if SETTINGS.dataset.original_heights else [],
    output:
        directory("originals/{city}"),
    log:
        "logs/originals/{city}.log",
    benchmark:
        "logs/originals/{city}.tsv"
    threads: 2
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        sources=upstream("originals"),
        images=lambda w: {s.scene: IMAGE_NAMES[s.scene] for s in scenes_of(w.city)},
        cells=lambda w: {
            s.scene: [cells_of(name) for name in IMAGE_NAMES[s.scene]] for s in scenes_of(w.city)
        },
        code=source_digest("stereotruth.tiles.originals"),
    message:
        "Cropping the original images of {wildcards.city}"
    script:
        "../scripts/originals.py"


rule dataset:
    input:
        tiles=tiles_of_dataset,
        originals=expand("originals/{city}", city=CITIES if SETTINGS.dataset.originals else []),
    output:
        directory("dataset"),
        [directory(f"dataset_{name}") for name in SETTINGS.dataset.layouts if name != "whu"],
    log:
        "logs/dataset/dataset.log",
    benchmark:
        "logs/dataset/dataset.tsv"
    resources:
        mem_mb=1000,
        runtime=60,
    params:
        sources=upstream("dataset"),
        described={
            "catalogs": list(SETTINGS.dataset.catalogs),
            "acquired": SETTINGS.dataset.acquired,
            "licence": SETTINGS.dataset.licence,
        },
        layouts=[name for name in SETTINGS.dataset.layouts if name != "whu"],
        code=source_digest("stereotruth.tiles.layouts"),
    message:
        "Putting the cities together in the layout of the published dataset"
    script:
        "../scripts/dataset.py"


rule verify:
    log:
        "logs/verify/verify.log",
    resources:
        mem_mb=1000,
        runtime=60,
    params:
        folders=[*(f"tiles/{city}" for city in CITIES), "dataset"],
    message:
        "Holding tiles and dataset against the checksums of their manifests"
    script:
        "../scripts/verify.py"
