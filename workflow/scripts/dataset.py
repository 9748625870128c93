"""All cities' tiles in the layout of the published dataset."""

from stereotruth.dataset.published_layout import assemble_dataset
from stereotruth.job import job
from stereotruth.products.publication import publication

if __name__ == "__main__":
    with (
        job(snakemake.log[0], "dataset"),
        publication(snakemake.input, snakemake.output, snakemake.params.made),
    ):
        assemble_dataset(snakemake.input, snakemake.output[0])
