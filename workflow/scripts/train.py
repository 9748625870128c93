"""A network trained on a dataset."""

from pathlib import Path

from stereotruth.matching.kinds import need_pytorch
from stereotruth.matching.layouts import StereoDataset
from stereotruth.runlog import job

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    with job(snakemake.log[0], f"train {of.dataset} {of.method}"):
        need_pytorch(of.method, params.kind)
        from stereotruth.matching.training import Training, model_of, train

        dataset = StereoDataset.of(of.dataset, params.dataset)
        training = Training.of(params.training)
        train(
            model_of(params.kind, dataset, training),
            dataset,
            Path(snakemake.output.weights).parent,
            training.on(snakemake.threads),
            provenance={
                "dataset": of.dataset,
                "method": of.method,
                "settings": params.dataset,
                "code": params.code,
            },
        )
