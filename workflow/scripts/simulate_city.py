"""What stands in a synthetic city, for the jobs that look at it."""

from stereocities.cities import city_of
from stereocities.world import write_surfaces
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    with rule_job(snakemake, f"simulate {city.name}"):
        write_surfaces(city, snakemake.output.surfaces)
