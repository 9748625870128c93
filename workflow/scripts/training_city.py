"""Tiles of one training city, with exact labels."""

from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.evaluate.exact_tiles import make_city

if __name__ == "__main__":
    number = snakemake.wildcards.number
    with (
        job(snakemake.log[0], f"training_city {number}"),
        making(snakemake.input, snakemake.output),
    ):
        make_city(
            int(number),
            snakemake.output[0],
            size=snakemake.params.size,
            seed=snakemake.params.seed,
            workers=snakemake.threads,
        )
