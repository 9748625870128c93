rule simulate_city:
    input:
        city=file_of_city,
        place=files_of_place,
    output:
        surfaces="data/synthetic/{city}/surfaces.npz",
    log:
        "logs/simulate_city/{city}.log",
    benchmark:
        "logs/simulate_city/{city}.tsv"
    resources:
        mem_mb=8000,  # of a twin 2 km wide; a drawn city takes a quarter
        runtime=30,
    params:
        sources=upstream("simulate_city"),
        code=source_digest("stereocities.world", "stereocities.cities"),
    message:
        "Building synthetic city {wildcards.city}"
    script:
        "../scripts/simulate_city.py"


rule simulate_image:
    input:
        city=file_of_city,
        place=files_of_place,
        surfaces=rules.simulate_city.output.surfaces,
    output:
        image="data/synthetic/{city}/{scene}/{view}.tif",
    log:
        "logs/simulate_image/{city}/{scene}/{view}.log",
    benchmark:
        "logs/simulate_image/{city}/{scene}/{view}.tsv"
    resources:
        mem_mb=3000,
        runtime=30,
    params:
        sources=upstream("simulate_image"),
        seed=SETTINGS.seed,
        code=source_digest("stereocities.render", "stereocities.cities"),
    message:
        "Rendering the {wildcards.view} image of synthetic scene {wildcards.scene}"
    script:
        "../scripts/simulate_image.py"


rule simulate_lidar:
    input:
        city=file_of_city,
        surfaces=rules.simulate_city.output.surfaces,
    output:
        lidar="data/synthetic/{city}/{scene}/lidar/{tile}",
    log:
        "logs/simulate_lidar/{city}/{scene}/{tile}.log",
    benchmark:
        "logs/simulate_lidar/{city}/{scene}/{tile}.tsv"
    resources:
        mem_mb=3000,
        runtime=30,
    params:
        sources=upstream("simulate_lidar"),
        spacing_m=SETTINGS.simulate.lidar_spacing_m,
        seed=SETTINGS.seed,
        code=source_digest("stereocities.lidar", "stereocities.cities"),
    message:
        "Flying LiDAR tile {wildcards.tile} of synthetic scene {wildcards.scene}"
    script:
        "../scripts/simulate_lidar.py"


rule simulate_truth:
    input:
        city=file_of_city,
        place=files_of_place,
    output:
        truth=directory("data/synthetic/{city}/{scene}/truth.zarr"),
        measured="data/synthetic/{city}/{scene}/gcps.csv",
        gcps="data/synthetic/{city}/{scene}/gcps_exact.csv",
        checkpoints="data/synthetic/{city}/{scene}/checkpoints.csv",
    log:
        "logs/simulate_truth/{city}/{scene}.log",
    benchmark:
        "logs/simulate_truth/{city}/{scene}.tsv"
    resources:
        mem_mb=3000,
        runtime=30,
    params:
        sources=upstream("simulate_truth"),
        seed=SETTINGS.seed,
        code=source_digest(
            "stereocities.truth", "stereocities.control_points", "stereocities.cities"
        ),
    message:
        "Writing the exact truth of synthetic scene {wildcards.scene}"
    script:
        "../scripts/simulate_truth.py"
