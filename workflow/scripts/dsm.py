"""A scene's disparities to a surface model."""

from stereobench.methods.surface_model import write_dsm
from stereotruth.core.job import dask_scheduler
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    scene, method = snakemake.wildcards.scene, snakemake.wildcards.method
    address = snakemake.resources.dask
    with rule_job(snakemake, f"dsm {scene} {method}"), dask_scheduler(address) as scheduler:
        write_dsm(
            snakemake.input.disparity,
            snakemake.output.dsm,
            **snakemake.params.settings,
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
        )
