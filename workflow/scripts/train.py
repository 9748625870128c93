"""A network trained on a dataset."""

from pathlib import Path

from stereobench.methods.kinds import need_pytorch
from stereotruth.core.products.making import rule_job
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    with rule_job(snakemake, f"train {of.dataset} {of.method}"):
        need_pytorch(of.method, params.kind)
        from stereobench.networks.training import train
        from stereobench.networks.training_state import TrainingSettings, model_of

        dataset = StereoDataset.of(of.dataset, params.dataset)
        training = TrainingSettings(**params.training)
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
