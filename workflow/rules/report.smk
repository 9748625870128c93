rule report_city:
    input:
        tiles="tiles/{city}",
        coverage="results/export/{city}/coverage.png",
        looks="results/export/{city}/quick_looks",
        alignments=lambda w: [
            f"results/align/{w.city}/{s.scene}/alignment.json" for s in scenes_of(w.city)
        ],
        refinements=refinements,
        refinement_figures=refinement_figures,
        table4=rules.evaluate_images.output.table4,
        sift=rules.evaluate_images.output.sift,
        sift_figure=rules.evaluate_images.output.sift_figure,
        truth=lambda w: truth_of_city(w.city, "json"),
        truth_table=lambda w: truth_of_city(w.city, "csv"),
    output:
        report(
            "results/report/{city}/index.html",
            caption="../report/page.rst",
            category="Pages",
            labels={"city": "{city}"},
        ),
    log:
        "logs/report_city/{city}.log",
    benchmark:
        "logs/report_city/{city}.tsv"
    conda:
        CONDA
    threads: 2
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        script=content_of("../scripts/report_city.py"),
        sliders=SETTINGS.report.sliders,
        code=source_digest("report.page"),
        templates=templates_of("report", "page.html.jinja"),
    message:
        "Writing the page of {wildcards.city}"
    script:
        "../scripts/report_city.py"


rule report:
    input:
        lambda w: expand("results/report/{city}/index.html", city=cities_of_report()),
    message:
        "Pages of all cities"


rule index:
    message:
        "Index of the pages that there are, as at the end of each run"
