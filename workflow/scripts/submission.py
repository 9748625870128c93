"""The results of a stereo method, packed to be scored elsewhere."""

from stereobench.scores.prediction_files import pack
from stereotruth.core.job import job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    of = snakemake.wildcards
    with (
        job(snakemake.log[0], f"submission {of.dataset} {of.method}"),
        making(snakemake.input, snakemake.output),
    ):
        pack(snakemake.input.predictions, snakemake.input.scores, snakemake.output[0])
