rule audit:
    input:
        dataset=lambda w: dataset_folder(w.dataset),
    output:
        directory("audit/{dataset}"),
    log:
        "logs/audit/{dataset}.log",
    benchmark:
        "benchmarks/audit/{dataset}.tsv"
    wildcard_constraints:
        dataset="[^/]+",
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        dataset=lambda w: {k: v for k, v in dataset_settings(w.dataset).items() if k != "methods"},
        limits={k: v for k, v in config["audit"].items() if k != "worst"},
        worst=config["audit"]["worst"],
        measuring=source_digest("evaluation.audit.pair", "evaluation.audit.sharing"),
        code=source_digest("evaluation.audit.audit"),
        template=file_sha256(PACKAGE / "evaluation" / "audit" / "page.html.jinja"),
    message:
        "Auditing dataset {wildcards.dataset}"
    script:
        "../scripts/audit.py"
