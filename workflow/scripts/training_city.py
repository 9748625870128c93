"""Tiles of one training city, with exact labels."""

from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.exact_tiles import make_city

if __name__ == "__main__":
    number = snakemake.wildcards.number
    with rule_job(snakemake, f"training_city {number}"):
        make_city(
            int(number),
            snakemake.output[0],
            size=snakemake.params.size,
            seed=snakemake.params.seed,
            workers=snakemake.threads,
        )
