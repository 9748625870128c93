"""Tiles of training cities put together as a dataset."""

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.exact_tiles import gather

if __name__ == "__main__":
    count = snakemake.wildcards.tiles
    with rule_job(snakemake, f"training_cities {count}"):
        gather(
            snakemake.input.training,
            snakemake.input.validation,
            snakemake.output[0],
            int(count),
        )
