"""The exact truth of one synthetic scene on its left epipolar grid."""

from stereocities.cities import city_of
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import describe
from stereotruth.evaluate.epipolar_truth import write_grid_truth

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    with rule_job(snakemake, f"truth of {scene.name}"):
        write_grid_truth(
            city,
            scene,
            snakemake.input.epipolar,
            snakemake.output.truth,
            workers=snakemake.threads,
            provenance=describe([snakemake.input.epipolar], {}, snakemake.params.code),
        )
