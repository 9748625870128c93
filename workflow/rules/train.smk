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
