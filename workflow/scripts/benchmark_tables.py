"""The stereo methods of a dataset side by side."""

from pathlib import Path

from stereotruth.dataset.stereo_dataset import StereoDataset
from stereotruth.job import job
from stereotruth.matching.benchmark.compare_methods import compare
from stereotruth.pages.page import INDEX
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.report.index_page import write_index

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    with (
        job(snakemake.log[0], f"benchmark {of.dataset}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        compare(
            StereoDataset.of(of.dataset, params.dataset),
            params.split,
            snakemake.input.scores,
            snakemake.input.predictions,
            Path(snakemake.output.page).parent,
            seed=params.seed,
            index=INDEX,
        )
        write_index()
