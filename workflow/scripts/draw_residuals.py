"""One scene's residuals of the ground control points, drawn."""

from stereotruth.alignment.align_figure import draw_residuals
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.job import job
from stereotruth.products.making import making

if __name__ == "__main__":
    with (
        job(snakemake.log[0], f"draw residuals {snakemake.wildcards.scene}"),
        making(snakemake.input, snakemake.output),
    ):
        draw_residuals(Alignment.load(snakemake.input.alignment), snakemake.output.figure)
