"""A stereo method over the pairs of a dataset."""

from pathlib import Path

from stereotruth.matching.kinds import NETWORKS
from stereotruth.matching.layouts import StereoDataset
from stereotruth.matching.predictions import predict
from stereotruth.runlog import job

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
