"""One aligned pair to epipolar images."""

from stereotruth.align.alignment import Alignment
from stereotruth.core.config.labels import Rectify
from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.core.products.provenance import checksums, describe
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.rectify import rectify
from stereotruth.sensor.image_reader import open_pair

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    given = snakemake.input
    files = [*given.left, *given.right, given.alignment]
    names, masks = (given.left[0], given.right[0]), (given.left_mask, given.right_mask)
    with (
        job(snakemake.log[0], f"rectify {scene}"),
        making(snakemake.input, snakemake.output),
    ):
        alignment = Alignment.read(snakemake.input.alignment)
        bands = Rectify(**snakemake.params.bands)
        with open_pair(*names, *masks, bands=bands) as (left, right):
            model = fit_epipolar(
                alignment.left,
                alignment.right,
                left.size,
                right.size,
                alignment.reference_height,
                height_range=alignment.model_heights,
                names=names,
            )
            rectify(
                left,
                right,
                model,
                snakemake.output.epipolar,
                snakemake.output.left,
                snakemake.output.right,
                workers=snakemake.threads,
                provenance=describe(
                    checksums(files, *masks), snakemake.params.bands, snakemake.params.code
                ),
            )
