"""One scene's points to its disparity grid."""

from stereotruth.disparity.project import project_scene
from stereotruth.disparity.settings import Settings
from stereotruth.job import dask_scheduler, job, scheduler_address
from stereotruth.products.publication import publication

if __name__ == "__main__":
    scene, address = snakemake.wildcards.scene, scheduler_address(snakemake.config)
    with (
        job(snakemake.log[0], f"project {scene}"),
        publication(snakemake.input, snakemake.output, snakemake.params),
        dask_scheduler(address) as scheduler,
    ):
        project_scene(
            snakemake.input.left,
            snakemake.input.right,
            snakemake.input.points,
            snakemake.output.disparity,
            Settings(**snakemake.params.settings),
            alignment=snakemake.input.alignment,
            view=snakemake.params.view,
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
        )
