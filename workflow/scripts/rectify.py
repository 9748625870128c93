"""One aligned pair to epipolar images."""

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.epipolar.rectify import rectify
from stereotruth.job import job
from stereotruth.products.provenance import describe

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    files = [*snakemake.input.left, *snakemake.input.right, snakemake.input.alignment]
    with job(snakemake.log[0], f"rectify {scene}"):
        alignment = Alignment.load(snakemake.input.alignment)
        rectify(
            snakemake.input.left[0],
            snakemake.input.right[0],
            alignment.left,
            alignment.right,
            alignment.reference_height,
            snakemake.output.epipolar,
            snakemake.output.left,
            snakemake.output.right,
            workers=snakemake.threads,
            label_sigma=alignment.label_sigma,
            provenance=describe(files, {}, snakemake.params.code),
        )
