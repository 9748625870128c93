"""The exact truth of one synthetic scene on its left epipolar grid."""

from stereotruth.evaluation.epipolar_truth import write_grid_truth
from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.products.provenance import describe
from stereotruth.simulate.cities import city_of

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    with (
        job(snakemake.log[0], f"truth of {scene.name}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        write_grid_truth(
            city,
            scene,
            snakemake.input.epipolar,
            snakemake.output.truth,
            workers=snakemake.threads,
            provenance=describe([snakemake.input.epipolar], {}, snakemake.params.code),
        )
