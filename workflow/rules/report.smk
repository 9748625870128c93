rule report_city:
    input:
        tiles="tiles/{city}",
        summary="results/export/{city}/summary.json",
        coverage="results/export/{city}/coverage.png",
        looks="results/export/{city}/quick_looks",
        alignments=of_scenes("results/align/{city}/{scene}/alignment.json"),
        refinements=refinements,
        residual_figures=of_scenes("results/align/{city}/{scene}/residuals.png"),
        refinement_figures=refinement_figures,
        table4=rules.evaluate_images.output.table4,
        sift=rules.evaluate_images.output.sift,
        sift_figure=rules.evaluate_images.output.sift_figure,
        truth=of_synthetic("results/evaluate/{city}/truth.json"),
        truth_table=of_synthetic("results/evaluate/{city}/truth.csv"),
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
    threads: 2
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        sources=upstream("report_city"),
        sliders=SETTINGS.report.sliders,
        code=source_digest("stereotruth.evaluate.report.page"),
        templates=templates_of("stereotruth/evaluate/report/page.html.jinja"),
    message:
        "Writing the page of {wildcards.city}"
    script:
        "../scripts/report_city.py"


rule report_site:
    input:
        images=files_of_sheet,
        points=point_stores_of_city,
        adjusted=of_adjusted("results/adjust/{city}.json"),
        closure=closure_of,
        page="results/report/{city}/index.html",
    output:
        report(
            "results/site/{city}/index.html",
            caption="../report/site.rst",
            category="Pages",
            labels={"city": "{city}, its images"},
        ),
    log:
        "logs/report_site/{city}.log",
    benchmark:
        "logs/report_site/{city}.tsv"
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        sources=upstream("report_site"),
        images=lambda w: {
            name: [file_of_image(row), row.acquired, row.sun_azimuth, row.sun_elevation]
            for name, row in sheet_images(w.city).items()
        },
        scenes=lambda w: {s.scene: IMAGE_NAMES[s.scene] for s in scenes_of(w.city)},
        code=source_digest(
            "stereotruth.evaluate.report.site_page",
            "stereotruth.align.images",
            "stereotruth.lidar.point_statistics",
        ),
        templates=templates_of("stereotruth/evaluate/report/site_page.html.jinja"),
    message:
        "Writing the page of the images of {wildcards.city}"
    script:
        "../scripts/report_site.py"


rule report:
    input:
        lambda w: expand("results/report/{city}/index.html", city=cities_of_report()),
        lambda w: expand("results/site/{city}/index.html", city=filter(is_site, cities_of_report())),
    message:
        "Pages of all cities"


rule index:
    message:
        "Index of the pages that there are, as at the end of each run"
