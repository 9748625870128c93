rule train:
    input:
        dataset=lambda w: dataset_folder(w.dataset),
        initial=lambda w: [given(f) for f in [training_of(w.method)["initial_weights"]] if f],
    output:
        weights="results/train/{dataset}/{method}/best.pt",
        curves="results/train/{dataset}/{method}/curves.csv",
        summary="results/train/{dataset}/{method}/training.json",
        figure=report(
            "results/train/{dataset}/{method}/curves.png",
            caption="../report/training.rst",
            category="Stereo methods",
            labels={"dataset": "{dataset}", "kind": "training of {method}"},
        ),
    log:
        "logs/train/{dataset}/{method}.log",
    benchmark:
        "logs/train/{dataset}/{method}.tsv"
    wildcard_constraints:
        dataset="[^/]+",
        method="[^/]+",
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=12000,
        runtime=2880,
    params:
        sources=upstream("train"),
        dataset=lambda w: dataset_entry(w.dataset),
        kind=lambda w: method_settings(w.method).kind,
        training=lambda w: training_of(w.method),
        code=lambda w: source_digest(
            "stereobench.networks.training", "stereobench.methods.kinds", *method_modules(w.method)
        ),
    message:
        "Training {wildcards.method} on dataset {wildcards.dataset}"
    script:
        "../scripts/train.py"


from stereocities.cities import cities_for


rule training_city:
    output:
        directory("results/training_cities/cities/{number}"),
    log:
        "logs/training_city/{number}.log",
    benchmark:
        "logs/training_city/{number}.tsv"
    wildcard_constraints:
        number="[0-9]+",
    conda:
        CONDA
    resources:
        mem_mb=3000,
        runtime=60,
    params:
        sources=upstream("training_city"),
        size=SETTINGS.tiles.size,
        seed=SETTINGS.seed,
        code=source_digest("stereotruth.evaluate.exact_tiles"),
    message:
        "Tiles of training city {wildcards.number}"
    script:
        "../scripts/training_city.py"


rule training_cities:
    input:
        training=lambda w: expand(rules.training_city.output[0], number=cities_for(int(w.tiles))[0]),
        validation=lambda w: expand(
            rules.training_city.output[0], number=cities_for(int(w.tiles))[1]
        ),
    output:
        directory("results/training_cities/{tiles}"),
    log:
        "logs/training_cities/{tiles}.log",
    benchmark:
        "logs/training_cities/{tiles}.tsv"
    wildcard_constraints:
        tiles="[1-9][0-9]*",
    conda:
        CONDA
    resources:
        mem_mb=500,
        runtime=30,
    params:
        sources=upstream("training_cities"),
        code=source_digest("stereotruth.evaluate.exact_tiles"),
    message:
        "{wildcards.tiles} tiles of training cities"
    script:
        "../scripts/training_cities.py"
