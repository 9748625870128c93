rule audit:
    input:
        dataset=lambda w: dataset_folder(w.dataset),
    output:
        directory("audit/{dataset}"),
    log:
        "logs/audit/{dataset}.log",
    benchmark:
        "logs/audit/{dataset}.tsv"
    threads: 2
    resources:
        mem_mb=4000,
        runtime=240,
    params:
        sources=upstream("audit"),
        dataset=lambda w: dataset_entry(w.dataset),
        settings=SETTINGS.audit.model_dump(),
        measuring=source_digest("stereobench.audit.pair"),
        code=source_digest("stereobench.audit.audit"),
        templates=templates_of("stereobench/audit/page.html.jinja"),
    message:
        "Auditing dataset {wildcards.dataset}"
    script:
        "../scripts/audit.py"
