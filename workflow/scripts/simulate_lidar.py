"""One LiDAR file of a synthetic scene."""

from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.simulate.cities import city_of
from stereotruth.simulate.lidar import simulate_lidar_tile

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    scene = city.scene(snakemake.wildcards.scene)
    tile = snakemake.wildcards.tile
    with (
        job(snakemake.log[0], f"simulate {tile}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
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
