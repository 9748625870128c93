"""One scene's residuals of the ground control points, drawn."""

from stereotruth.align.alignment import Alignment
from stereotruth.align.figures import draw_residuals
from stereotruth.core.job import job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    with (
        job(snakemake.log[0], f"draw residuals {snakemake.wildcards.scene}"),
        making(snakemake.input, snakemake.output),
    ):
        draw_residuals(Alignment.read(snakemake.input.alignment), snakemake.output.figure)
