"""One aligned pair to epipolar images, or to one strip of their blocks."""

from stereotruth.align.alignment import Alignment
from stereotruth.core.config.configuration import Rectify
from stereotruth.core.products.grids import Strip
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import checksums, describe
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.rectify import rectify
from stereotruth.sensor.images import open_pair

if __name__ == "__main__":
    scene, given, made = snakemake.wildcards.scene, snakemake.input, snakemake.output
    strip, bands = Strip.of_wildcards(snakemake.wildcards), snakemake.params.bands
    names, masks = (given.left[0], given.right[0]), (given.left_mask, given.right_mask)
    with rule_job(snakemake, f"rectify {scene} {strip or ''}".strip()):
        alignment = Alignment.read(given.alignment)
        with open_pair(*names, *masks, bands=Rectify(**bands)) as (left, right):
            model = fit_epipolar(
                alignment.left,
                alignment.right,
                left.size,
                right.size,
                alignment.reference_height,
                height_range=alignment.model_heights,
                names=names,
            )
            if strip:
                stores = snakemake.params.stores
                rectify(left, right, model, None, *stores, workers=snakemake.threads, strip=strip)
                strip.tell(made.done)
            else:
                inputs = checksums([*given.left, *given.right, given.alignment], *masks)
                rectify(
                    left,
                    right,
                    model,
                    made.epipolar,
                    made.left,
                    made.right,
                    workers=snakemake.threads,
                    provenance=describe(inputs, bands, snakemake.params.code),
                )
