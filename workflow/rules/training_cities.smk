"""Tiles of cities that no test shows, to train on."""

from stereocities.cities import cities_for


rule training_city:
    output:
        directory("results/training_cities/cities/{number}"),
    log:
        "logs/training_city/{number}.log",
    benchmark:
        "logs/training_city/{number}.tsv"
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
