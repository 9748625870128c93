"""What the images and labels of a dataset say of each other."""

from stereobench.audit.audit import audit
from stereotruth.core.config.methods import Audit
from stereotruth.core.products.making import rule_job
from stereotruth.evaluate.report.index_page import write_index
from stereotruth.pages.page import INDEX
from stereotruth.tiles.stereo_dataset import StereoDataset

if __name__ == "__main__":
    name, params = snakemake.wildcards.dataset, snakemake.params
    with rule_job(snakemake, f"audit {name}"):
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
