rule grid_truth:
    input:
        epipolar=rules.rectify.output.epipolar,
        city=file_of_city,
        place=files_of_place,
    output:
        truth=directory("results/truth/{city}/{scene}.zarr"),
    log:
        "logs/grid_truth/{city}/{scene}.log",
    benchmark:
        "logs/grid_truth/{city}/{scene}.tsv"
    threads: 2
    resources:
        mem_mb=3000,
        runtime=60,
    params:
        sources=upstream("grid_truth"),
        code=source_digest("stereotruth.evaluate.epipolar_truth", "stereocities.cities"),
    message:
        "Casting rays through the epipolar pixels of synthetic scene {wildcards.scene}"
    script:
        "../scripts/grid_truth.py"


rule evaluate_truth:
    input:
        disparity="results/project/{city}/{scene}.zarr",
        tiles="tiles/{city}",
        truth=rules.grid_truth.output.truth,
    output:
        figures="results/evaluate/{city}/{scene}/truth.json",
        table=report(
            "results/evaluate/{city}/{scene}/truth.csv",
            caption="../report/truth.rst",
            category="Exact truth",
            labels={"scene": "{scene}"},
        ),
    log:
        "logs/evaluate_truth/{city}/{scene}.log",
    benchmark:
        "logs/evaluate_truth/{city}/{scene}.tsv"
    threads: 2
    resources:
        mem_mb=3000,
        runtime=60,
    params:
        sources=upstream("evaluate_truth"),
        scenes=lambda w: [w.scene],
        code=source_digest("stereotruth.evaluate.labels_against_truth"),
    message:
        "Comparing scene {wildcards.scene} with its exact truth"
    script:
        "../scripts/evaluate_truth.py"


use rule evaluate_truth as evaluate_truth_city with:
    input:
        disparity=lambda w: expand(
            "results/project/{city}/{scene}.zarr", city=w.city, scene=synthetic_scenes(w.city)
        ),
        tiles="tiles/{city}",
        truth=lambda w: expand(
            rules.grid_truth.output.truth, city=w.city, scene=synthetic_scenes(w.city)
        ),
    output:
        figures="results/evaluate/{city}/truth.json",
        table=report(
            "results/evaluate/{city}/truth.csv",
            caption="../report/truth.rst",
            category="Exact truth",
            labels={"city": "{city}"},
        ),
    log:
        "logs/evaluate_truth_city/{city}.log",
    benchmark:
        "logs/evaluate_truth_city/{city}.tsv"
    params:
        sources=upstream("evaluate_truth_city", "evaluate_truth"),
        scenes=lambda w: synthetic_scenes(w.city),
        code=source_digest("stereotruth.evaluate.labels_against_truth"),
    message:
        "Comparing city {wildcards.city} with its exact truth"


rule evaluate:
    input:
        [f"results/evaluate/{s.city}/{s.scene}/truth.json" for s in SCENES.values() if has_truth(s)],
        [f"results/evaluate/{city}/truth.json" for city in CITIES if synthetic_scenes(city)],
        [f"results/evaluate/{s.city}/table4.csv" for s in SCENES.values()],
    message:
        "Figures of all cities from their images, of synthetic ones from the exact truth too"
