"""One strip of an aligned pair to blocks of its epipolar images."""

from stereotruth.alignment import Alignment
from stereotruth.grid_store import Strip
from stereotruth.rectification import rectify
from stereotruth.runlog import job

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
