"""A stereo method over the pairs of a dataset."""

from pathlib import Path

from stereobench.scores.predictions import predict
from stereotruth.core.products.making import rule_job
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    out = Path(snakemake.output[0])
    with rule_job(snakemake, f"match {of.dataset} {of.method}"):
        predict(
            StereoDataset.of(of.dataset, params.dataset),
            params.split,
            of.method,
            params.method,
            out,
            work=out.with_name(f".{out.name}.work"),
            files=snakemake.input.files,
            workers=snakemake.threads,
            code=params.code,
        )
