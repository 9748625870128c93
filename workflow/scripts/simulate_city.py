"""What stands in a synthetic city, for the jobs that look at it."""

from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.simulate.built_city import write_surfaces
from stereotruth.simulate.cities import city_of

if __name__ == "__main__":
    city = city_of(snakemake.wildcards.city)
    with (
        job(snakemake.log[0], f"simulate {city.name}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        write_surfaces(city, snakemake.output.surfaces)
