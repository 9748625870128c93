"""One LiDAR file of a synthetic scene."""

from stereocities.cities import city_of
from stereocities.lidar import simulate_lidar_tile
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    tile = snakemake.wildcards.tile
    with rule_job(snakemake, f"simulate {tile}"):
        simulate_lidar_tile(
            city,
            scene,
            tile,
            snakemake.output.lidar,
            spacing_m=snakemake.params.spacing_m,
            seed=snakemake.params.seed,
            built=snakemake.input.surfaces,
        )
