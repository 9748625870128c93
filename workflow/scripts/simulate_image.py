"""One image of a synthetic scene."""

from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.simulate.cities import city_of
from stereotruth.simulate.render import simulate_image

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    view = snakemake.wildcards.view
    with (
        job(snakemake.log[0], f"simulate {scene.name} {view}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        simulate_image(
            city,
            scene,
            view,
            snakemake.output.image,
            seed=snakemake.params.seed,
            built=snakemake.input.surfaces,
        )
