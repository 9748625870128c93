"""One strip of an aligned pair to blocks of its epipolar images."""

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.epipolar.rectify import rectify
from stereotruth.job import job
from stereotruth.products.grids import Strip

if __name__ == "__main__":
    scene, strip = snakemake.wildcards.scene, Strip.parse(snakemake.wildcards.strip)
    with job(snakemake.log[0], f"rectify {scene} {strip}"):
        alignment = Alignment.load(snakemake.input.alignment)
        rectify(
            snakemake.input.left[0],
            snakemake.input.right[0],
            alignment.left,
            alignment.right,
            alignment.reference_height,
            None,
            *snakemake.params.stores,
            workers=snakemake.threads,
            strip=strip,
        )
        strip.tell(snakemake.output.done)
