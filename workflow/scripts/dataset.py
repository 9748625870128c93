"""All cities' tiles in the layout of the published dataset."""

from stereotruth.dataset import assemble_dataset
from stereotruth.runlog import job

if __name__ == "__main__":
    with job(snakemake.log[0], "dataset"):
        assemble_dataset(snakemake.input, snakemake.output[0])
