"""The stereo methods of a dataset side by side."""

from pathlib import Path

from stereobench.scores.compare_methods import compare
from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.report.index_page import write_index
from stereotruth.pages.page import INDEX
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    of, params = snakemake.wildcards, snakemake.params
    with rule_job(snakemake, f"benchmark {of.dataset}"):
        compare(
            StereoDataset.of(of.dataset, params.dataset),
            params.split,
            snakemake.input.scores,
            snakemake.input.predictions,
            Path(snakemake.output.page).parent,
            index=INDEX,
        )
        write_index()
