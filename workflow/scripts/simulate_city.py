"""What stands in a synthetic city, for the jobs that look at it."""

from stereocities.cities import city_of
from stereocities.world import write_surfaces
from stereotruth.core.job import job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    with (
        job(snakemake.log[0], f"simulate {city.name}"),
        making(snakemake.input, snakemake.output),
    ):
        write_surfaces(city, snakemake.output.surfaces)
