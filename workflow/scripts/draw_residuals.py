"""One scene's residuals of the ground control points, drawn."""

from stereotruth.align.align_figure import draw_residuals
from stereotruth.align.aligned_pair import Alignment
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    with rule_job(snakemake, f"draw residuals {snakemake.wildcards.scene}"):
        draw_residuals(Alignment.load(snakemake.input.alignment), snakemake.output.figure)
