"""Crops of one city's original images, with corrected RPCs."""

from stereotruth.dataset.originals import write_originals
from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs

if __name__ == "__main__":
    given, city = snakemake.input, snakemake.wildcards.city
    with (
        job(snakemake.log[0], f"originals {city}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        images = dict(zip(snakemake.params.scenes, zip(given.left, given.right)))
        write_originals(given.tiles, snakemake.output[0], images, workers=snakemake.threads)
