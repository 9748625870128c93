rule predict_scene:
    input:
        left=rules.rectify.output.left,
        right=rules.rectify.output.right,
        files=lambda w: method_files(w.method, prediction_dataset()),
    output:
        disparity=directory("results/predict/{city}/{scene}/{method}.zarr"),
    log:
        "logs/predict_scene/{city}/{scene}/{method}.log",
    benchmark:
        "logs/predict_scene/{city}/{scene}/{method}.tsv"
    threads: 2
    resources:
        mem_mb=6000,
        runtime=720,
        dask=SETTINGS.dask.scheduler_address or "",
    params:
        sources=upstream("predict_scene"),
        method=lambda w: method_entry(w.method, prediction_dataset()),
        settings=lambda w: scene_prediction(),
        code=lambda w: source_digest("stereobench.methods.predict_scene", *method_modules(w.method)),
    message:
        "Disparities of scene {wildcards.scene} by {wildcards.method}"
    script:
        "../scripts/predict_scene.py"


rule dsm:
    input:
        disparity=rules.predict_scene.output.disparity,
    output:
        dsm="results/predict/{city}/{scene}/{method}_dsm.tif",
    log:
        "logs/dsm/{city}/{scene}/{method}.log",
    benchmark:
        "logs/dsm/{city}/{scene}/{method}.tsv"
    threads: 2
    resources:
        mem_mb=2000,
        runtime=240,
        dask=SETTINGS.dask.scheduler_address or "",
    params:
        sources=upstream("dsm"),
        settings=SETTINGS.predict.dsm.model_dump(),
        code=source_digest("stereobench.methods.surface_model"),
    message:
        "Surface model of scene {wildcards.scene} by {wildcards.method}"
    script:
        "../scripts/dsm.py"


rule score_dsm:
    input:
        dsm=rules.dsm.output.dsm,
        points=point_stores,
    output:
        directory("score_dsm/{city}/{scene}/{method}"),
    log:
        "logs/score_dsm/{city}/{scene}/{method}.log",
    benchmark:
        "logs/score_dsm/{city}/{scene}/{method}.tsv"
    resources:
        mem_mb=3000,
        runtime=240,
    params:
        sources=upstream("score_dsm"),
        code=source_digest("stereotruth.evaluate.surface_models.score"),
        templates=templates_of("stereotruth/evaluate/surface_models/page.html.jinja"),
    message:
        "Judging the surface model of scene {wildcards.scene} by {wildcards.method}"
    script:
        "../scripts/score_dsm.py"


rule predict:
    input:
        [
            f"results/predict/{s.city}/{s.scene}/{method}_dsm.tif"
            for s in SCENES.values()
            for method in SETTINGS.predict.methods
        ],
    message:
        "Disparities and surface models of all scenes"
