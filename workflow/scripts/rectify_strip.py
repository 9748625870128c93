"""One strip of an aligned pair to blocks of its epipolar images."""

from stereotruth.align.alignment import Alignment
from stereotruth.core.config.labels import Rectify
from stereotruth.core.job import job
from stereotruth.core.products.grids import Strip
from stereotruth.core.products.making import making
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.rectify import rectify
from stereotruth.sensor.image_reader import open_pair

if __name__ == "__main__":
    scene, strip = snakemake.wildcards.scene, Strip.parse(snakemake.wildcards.strip)
    given = snakemake.input
    names, masks = (given.left[0], given.right[0]), (given.left_mask, given.right_mask)
    with (
        job(snakemake.log[0], f"rectify {scene} {strip}"),
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
            stores = snakemake.params.stores
            rectify(left, right, model, None, *stores, workers=snakemake.threads, strip=strip)
        strip.tell(snakemake.output.done)
