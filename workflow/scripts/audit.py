"""What the images and labels of a dataset say of each other."""

from stereotruth.config.methods import Audit
from stereotruth.dataset.stereo_dataset import StereoDataset
from stereotruth.evaluation.audit.audit import audit
from stereotruth.job import job
from stereotruth.pages.page import INDEX
from stereotruth.products.making import making
from stereotruth.report.index_page import write_index

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
