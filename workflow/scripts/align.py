"""One scene's images to its ground control points."""

import logging
from contextlib import suppress

from stereotruth.align.align import align, from_rpcs, write_alignment
from stereotruth.align.control_points import TooFewPoints, read_gcps
from stereotruth.core.errors import InputError
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import describe
from stereotruth.lidar.frames import Epoch

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    model, strict = snakemake.params.model, snakemake.params.strict
    epoch = Epoch(*snakemake.params.epoch)
    with rule_job(snakemake, f"align {scene}"):
        images = snakemake.input.left[0], snakemake.input.right[0]
        provenance = describe(
            snakemake.input, {"model": model, "epoch": [*epoch]}, snakemake.params.code
        )
        alignment = None
        if snakemake.input.gcps and not snakemake.params.alone:
            with suppress(TooFewPoints):  # faults of the sheet itself are errors here, too
                read_gcps(snakemake.input.gcps, scene, snakemake.params.names, epoch)
        if snakemake.input.gcps:
            try:
                alignment = align(
                    *images,
                    snakemake.input.gcps,
                    names=snakemake.params.names,
                    model=model,
                    scene=scene,
                    strict=strict,
                    epoch=epoch,
                    provenance=provenance,
                )
            except InputError as error:
                if snakemake.params.alone:
                    raise
                # The points count among those of all images of the site (rule adjust).
                logging.getLogger("stereotruth").info("by the RPCs alone: %s", error)
        if alignment is None:
            alignment = from_rpcs(*images, model=model, scene=scene, provenance=provenance)
        write_alignment(alignment, snakemake.output.alignment, snakemake.output.residuals)
