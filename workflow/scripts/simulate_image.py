"""One image of a synthetic scene."""

from stereocities.cities import city_of
from stereocities.render import simulate_image
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    view = snakemake.wildcards.view
    with rule_job(snakemake, f"simulate {scene.name} {view}"):
        simulate_image(
            city,
            scene,
            view,
            snakemake.output.image,
            seed=snakemake.params.seed,
            built=snakemake.input.surfaces,
        )
