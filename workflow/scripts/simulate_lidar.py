"""One LiDAR file of a synthetic scene."""

from stereocities.cities import city_of
from stereocities.lidar import simulate_lidar_tile
from stereotruth.core.job import job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    tile = snakemake.wildcards.tile
    with (
        job(snakemake.log[0], f"simulate {tile}"),
        making(snakemake.input, snakemake.output),
    ):
        simulate_lidar_tile(
            city,
            scene,
            tile,
            snakemake.output.lidar,
            spacing_m=snakemake.params.spacing_m,
            seed=snakemake.params.seed,
            built=snakemake.input.surfaces,
        )
