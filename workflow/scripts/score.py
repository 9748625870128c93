"""The predictions of a stereo method against the labels of a dataset."""

from pathlib import Path

from stereobench.scores.score_method import ScoringPlan, score
from stereobench.scores.strata import Products
from stereotruth.core.products.making import rule_job
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    own = (Path("tiles"), Path("results/project"), Path("results/truth"))
    with rule_job(snakemake, f"score {of.dataset} {of.method}"):
        score(
            StereoDataset.of(of.dataset, params.dataset),
            params.split,
            params.label,
            snakemake.input.predictions,
            snakemake.output[0],
            ScoringPlan(
                params.thresholds_px, params.bootstrap, params.seed, params.panels, params.protocol
            ),
            fine_tuned_of=params.fine_tuned_of,
            products=Products(*own) if snakemake.input.strata else None,
        )
