"""A network trained on a dataset."""

from pathlib import Path

from stereotruth.dataset.stereo_dataset import StereoDataset
from stereotruth.job import job
from stereotruth.matching.kinds import need_pytorch
from stereotruth.products.making import making

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    with (
        job(snakemake.log[0], f"train {of.dataset} {of.method}"),
        making(snakemake.input, snakemake.output),
    ):
        need_pytorch(of.method, params.kind)
        from stereotruth.matching.networks.training import train
        from stereotruth.matching.networks.training_settings import TrainingSettings
        from stereotruth.matching.networks.training_state import model_of

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
