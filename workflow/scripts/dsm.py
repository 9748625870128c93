"""A scene's disparities to a surface model."""

from stereobench.methods.surface_model import write_dsm
from stereotruth.core.job import dask_scheduler, job
from stereotruth.core.products.making import making

if __name__ == "__main__":
    scene, method = snakemake.wildcards.scene, snakemake.wildcards.method
    address = snakemake.resources.dask
    with (
        job(snakemake.log[0], f"dsm {scene} {method}"),
        making(snakemake.input, snakemake.output),
        dask_scheduler(address) as scheduler,
    ):
        write_dsm(
            snakemake.input.disparity,
            snakemake.output.dsm,
            **snakemake.params.settings,
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
        )
