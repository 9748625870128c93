"""The results of a stereo method, packed to be scored elsewhere."""

from stereobench.scores.prediction_files import pack
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    of = snakemake.wildcards
    with rule_job(snakemake, f"submission {of.dataset} {of.method}"):
        scores = next(iter(snakemake.input.scores), None)  # none of sealed labels
        pack(snakemake.input.predictions, scores, snakemake.output[0])
