"""All cities' tiles in the layout of the published dataset, and in others."""

from stereotruth.dataset.other_layouts import write_layout
from stereotruth.dataset.published_layout import assemble_dataset
from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs

if __name__ == "__main__":
    dataset, *others = snakemake.output
    with (
        job(snakemake.log[0], "dataset"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        assemble_dataset(snakemake.input.tiles, dataset, **snakemake.params.catalogs)
        for layout, out in zip(snakemake.params.layouts, others, strict=True):
            write_layout(dataset, out, layout)
