"""What the images and labels of a dataset say of each other."""

from stereobench.audit.audit import audit
from stereotruth.core.config.methods import Audit
from stereotruth.core.job import job
from stereotruth.core.products.making import making
from stereotruth.evaluate.report.index_page import write_index
from stereotruth.pages.page import INDEX
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    name, params = snakemake.wildcards.dataset, snakemake.params
    with (
        job(snakemake.log[0], f"audit {name}"),
        making(snakemake.input, snakemake.output),
    ):
        audit(
            StereoDataset.of(name, params.dataset),
            snakemake.output[0],
            Audit(**params.settings),
            work=f"results/audit/{name}",
            workers=snakemake.threads,
            code=params.measuring,
            index=INDEX,
        )
        write_index()
