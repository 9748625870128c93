"""The exact truth of a synthetic scene: per pixel, and as points."""

from stereocities.cities import city_of
from stereocities.control_points import simulate_points
from stereocities.truth import simulate_truth
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    with rule_job(snakemake, f"simulate {scene.name} truth"):
        simulate_points(
            city,
            scene,
            snakemake.output.measured,
            snakemake.output.gcps,
            snakemake.output.checkpoints,
            seed=snakemake.params.seed,
        )
        simulate_truth(city, scene, snakemake.output.truth)
