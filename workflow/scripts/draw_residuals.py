"""One scene's residuals of the ground control points, drawn."""

from stereotruth.align.alignment import Alignment
from stereotruth.align.figures import draw_residuals
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    with rule_job(snakemake, f"draw residuals {snakemake.wildcards.scene}"):
        draw_residuals(Alignment.read(snakemake.input.alignment), snakemake.output.figure)
