"""A stereo method over the pairs of a dataset."""

from pathlib import Path

from stereobench.scores.predictions import predict
from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    out = Path(snakemake.output[0])
    with (
        job(snakemake.log[0], f"match {of.dataset} {of.method}"),
        making(snakemake.input, snakemake.output),
    ):
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
