"""Crops of one city's original images, with corrected cameras and heights."""

from pathlib import Path

from stereotruth.core.products.making import rule_job
from stereotruth.tiles.originals import write_originals

if __name__ == "__main__":
    given, city = snakemake.input, snakemake.wildcards.city
    with rule_job(snakemake, f"originals {city}"):
        names = snakemake.params.images
        images = dict(zip(names, zip(given.left, given.right)))
        stores = {Path(store).stem: store for store in given.heights}
        heights = {scene: tuple(map(stores.get, pair)) for scene, pair in names.items()}
        write_originals(
            given.tiles,
            snakemake.output[0],
            images,
            heights if stores else None,
            cells=snakemake.params.cells,
            workers=snakemake.threads,
        )
