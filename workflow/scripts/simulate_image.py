"""One image of a synthetic scene."""

from stereocities.cities import city_of
from stereocities.render import simulate_image
from stereotruth.core.job import job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    view = snakemake.wildcards.view
    with (
        job(snakemake.log[0], f"simulate {scene.name} {view}"),
        making(snakemake.input, snakemake.output),
    ):
        simulate_image(
            city,
            scene,
            view,
            snakemake.output.image,
            seed=snakemake.params.seed,
            built=snakemake.input.surfaces,
        )
