rule match:
    input:
        dataset=lambda w: dataset_folder(w.dataset),
        files=lambda w: method_files(w.method, w.dataset),
    output:
        directory("results/match/{dataset}/{method}"),
    log:
        "logs/match/{dataset}/{method}.log",
    benchmark:
        "logs/match/{dataset}/{method}.tsv"
    threads: 2
    resources:
        mem_mb=6000,
        runtime=480,
    params:
        sources=upstream("match"),
        dataset=lambda w: dataset_entry(w.dataset),
        method=lambda w: method_entry(w.method, w.dataset),
        split=SETTINGS.benchmark.split,
        code=lambda w: source_digest("stereobench.scores.predictions", *method_modules(w.method)),
    message:
        "Matching dataset {wildcards.dataset} by {wildcards.method}"
    script:
        "../scripts/match.py"


rule score:
    input:
        dataset=lambda w: dataset_folder(w.dataset),
        predictions=rules.match.output[0],
        strata=lambda w: products_of_own_dataset() if is_own_dataset(w.dataset) else [],
    output:
        directory("benchmark/{dataset}/{method}"),
    log:
        "logs/score/{dataset}/{method}.log",
    benchmark:
        "logs/score/{dataset}/{method}.tsv"
    wildcard_constraints:
        method="[^/.]+",  # not a table of all methods
    resources:
        mem_mb=2000,
        runtime=120,
    params:
        sources=upstream("score"),
        dataset=lambda w: dataset_entry(w.dataset),
        split=SETTINGS.benchmark.split,
        protocol=lambda w: dataset_settings(w.dataset).protocol,
        label=lambda w: method_label(w.method),
        fine_tuned_of=lambda w: method_settings(w.method).fine_tuned_of or None,
        thresholds_px=list(SETTINGS.benchmark.thresholds_px),
        bootstrap=SETTINGS.benchmark.bootstrap,
        panels=SETTINGS.benchmark.panels,
        seed=SETTINGS.seed,
        code=source_digest("stereobench.scores.score_method"),
    message:
        "Scoring {wildcards.method} on dataset {wildcards.dataset}"
    script:
        "../scripts/score.py"


rule submission:
    input:
        predictions=rules.match.output[0],
        scores=lambda w: [] if is_sealed(w.dataset) else expand(rules.score.output[0], **w),
    output:
        directory("submission/{dataset}/{method}"),
    log:
        "logs/submission/{dataset}/{method}.log",
    benchmark:
        "logs/submission/{dataset}/{method}.tsv"
    wildcard_constraints:
        method="[^/.]+",
    resources:
        mem_mb=1000,
        runtime=30,
    params:
        sources=upstream("submission"),
        code=source_digest("stereobench.scores.prediction_files"),
    message:
        "Packing the results of {wildcards.method} on dataset {wildcards.dataset}"
    script:
        "../scripts/submission.py"


rule benchmark_tables:
    input:
        dataset=lambda w: dataset_folder(w.dataset),
        scores=lambda w: expand(rules.score.output[0], **w, method=methods_of(w.dataset)),
        predictions=lambda w: expand(rules.match.output[0], **w, method=methods_of(w.dataset)),
    output:
        tables=expand(
            "benchmark/{{dataset}}/{table}.{kind}",
            table=(
                "methods",
                "by_city",
                "fine_tuned",
                "strata",
                "differences",
                "confidence",
                "published",
            ),
            kind=("csv", "md"),
        ),
        figure=report(
            "benchmark/{dataset}/figure10.png",
            caption="../report/figure10.rst",
            category="Stereo methods",
            labels={"dataset": "{dataset}", "kind": "figure 10"},
        ),
        page=report(
            "benchmark/{dataset}/index.html",
            caption="../report/benchmark.rst",
            category="Stereo methods",
            labels={"dataset": "{dataset}", "kind": "page"},
        ),
    log:
        "logs/benchmark_tables/{dataset}.log",
    benchmark:
        "logs/benchmark_tables/{dataset}.tsv"
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("benchmark_tables"),
        dataset=lambda w: dataset_entry(w.dataset),
        split=SETTINGS.benchmark.split,
        code=source_digest("stereobench.scores.compare_methods"),
        templates=templates_of("stereobench/scores/page.html.jinja"),
    message:
        "Comparing the methods on dataset {wildcards.dataset}"
    script:
        "../scripts/benchmark_tables.py"


rule benchmark:
    input:
        lambda w: expand(
            "benchmark/{dataset}/index.html",
            dataset=[name for name, of in SETTINGS.benchmark.datasets.items() if of],
        ),
    message:
        "All stereo methods on all datasets"
