"""One scene's tie points of the refinement, drawn."""

from stereotruth.align.alignment import Alignment
from stereotruth.align.figures import draw_refinement
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    given = snakemake.input
    with rule_job(snakemake, f"draw refinement {snakemake.wildcards.scene}"):
        draw_refinement(
            Alignment.read(given.alignment),
            given.observations,
            snakemake.output.figure,
            given.left[0],
        )
