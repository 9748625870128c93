"""One scene's tie points of the refinement, drawn."""

from stereotruth.align.alignment import Alignment
from stereotruth.align.figures import draw_refinement
from stereotruth.core.job import job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    given = snakemake.input
    with (
        job(snakemake.log[0], f"draw refinement {snakemake.wildcards.scene}"),
        making(snakemake.input, snakemake.output),
    ):
        draw_refinement(
            Alignment.read(given.alignment),
            given.observations,
            snakemake.output.figure,
            given.left[0],
        )
