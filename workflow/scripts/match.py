"""A stereo method over the pairs of a dataset."""

from pathlib import Path

from stereotruth.dataset.stereo_dataset import StereoDataset
from stereotruth.job import job
from stereotruth.matching.benchmark.predictions import predict
from stereotruth.matching.kinds import NETWORKS

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    out, settings = Path(snakemake.output[0]), dict(params.method)
    if settings["kind"] in NETWORKS:
        (settings["weights"],) = snakemake.input.files
    with job(snakemake.log[0], f"match {of.dataset} {of.method}"):
        predict(
            StereoDataset.of(of.dataset, params.dataset),
            params.split,
            of.method,
            settings,
            out,
            work=out.with_name(f".{out.name}.work"),
            files=snakemake.input.files,
            workers=snakemake.threads,
            code=params.code,
        )
