"""A stereo method over a whole scene."""

from stereobench.methods.predict_scene import predict_scene
from stereotruth.core.config.methods import SceneMatching
from stereotruth.core.job import dask_scheduler
from stereotruth.core.products.making import rule_job

if __name__ == "__main__":
    scene, method = snakemake.wildcards.scene, snakemake.wildcards.method
    address = snakemake.resources.dask
    with rule_job(snakemake, f"predict {scene} {method}"), dask_scheduler(address) as scheduler:
        predict_scene(
            snakemake.input.left,
            snakemake.input.right,
            snakemake.output.disparity,
            method=method,
            entry=snakemake.params.method,
            settings=SceneMatching(**snakemake.params.settings),
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
        )
