"""Heights, positions and classes of what an original image shows."""

from stereotruth.align.alignment import Alignment
from stereotruth.core.products.making import rule_job
from stereotruth.core.products.provenance import checksums, describe
from stereotruth.labels.image_heights import open_inputs, write_image_heights

if __name__ == "__main__":
    image, view = snakemake.wildcards.image, snakemake.params.view
    with rule_job(snakemake, f"heights {image}"):
        alignment = Alignment.read(snakemake.input.alignment)
        fit = getattr(alignment, f"{view}_fit")
        inputs = open_inputs(
            getattr(alignment, view),
            fit.size,
            snakemake.input.points,
            snakemake.input.surface,
            fit,
            alignment.of_lines(view),
        )
        made_of = inputs.made_of | checksums([snakemake.input.alignment])
        write_image_heights(
            inputs,
            snakemake.output.heights,
            image=image,
            workers=snakemake.threads,
            provenance=describe(made_of, {"view": view}, snakemake.params.code),
        )
