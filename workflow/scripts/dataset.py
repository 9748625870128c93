"""All cities' tiles in the layout of the published dataset, and in others."""

from stereotruth.core.products.making import rule_job
from stereotruth.tiles.layouts import assemble_dataset, write_layout

if __name__ == "__main__":
    dataset, *others = snakemake.output
    with rule_job(snakemake, "dataset"):
        assemble_dataset(snakemake.input.tiles, dataset, **snakemake.params.described)
        for layout, out in zip(snakemake.params.layouts, others, strict=True):
            write_layout(dataset, out, layout, licence=snakemake.params.described["licence"])
