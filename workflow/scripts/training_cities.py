"""Tiles of training cities put together as a dataset."""

from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.evaluate.exact_tiles import gather

if __name__ == "__main__":
    count = snakemake.wildcards.tiles
    with (
        job(snakemake.log[0], f"training_cities {count}"),
        making(snakemake.input, snakemake.output),
    ):
        gather(
            snakemake.input.training,
            snakemake.input.validation,
            snakemake.output[0],
            int(count),
        )
