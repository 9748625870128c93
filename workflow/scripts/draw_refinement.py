"""One scene's tie points of the refinement, drawn."""

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.refine_figure import draw_refinement
from stereotruth.job import job
from stereotruth.products.making import making

if __name__ == "__main__":
    given = snakemake.input
    with (
        job(snakemake.log[0], f"draw refinement {snakemake.wildcards.scene}"),
        making(snakemake.input, snakemake.output),
    ):
        draw_refinement(
            Alignment.load(given.alignment),
            given.observations,
            snakemake.output.figure,
            given.left[0],
        )
