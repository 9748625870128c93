"""The exact truth of a synthetic scene: per pixel, and as points."""

from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.simulate.cities import city_of
from stereotruth.simulate.control_points import simulate_points
from stereotruth.simulate.truth import simulate_truth

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    with (
        job(snakemake.log[0], f"simulate {scene.name} truth"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        simulate_points(
            city,
            scene,
            snakemake.output.measured,
            snakemake.output.gcps,
            snakemake.output.checkpoints,
            seed=snakemake.params.seed,
        )
        simulate_truth(city, scene, snakemake.output.truth)
