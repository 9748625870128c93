"""A stereo method over a whole scene."""

from stereotruth.job import dask_scheduler, job
from stereotruth.matching.kinds import NETWORKS
from stereotruth.matching.scenes.predict_scene import predict_scene

if __name__ == "__main__":
    scene, method = snakemake.wildcards.scene, snakemake.wildcards.method
    settings, address = (
        dict(snakemake.params.method),
        snakemake.config["dask"]["scheduler_address"],
    )
    if settings["kind"] in NETWORKS:
        (settings["weights"],) = snakemake.input.files
    with (
        job(snakemake.log[0], f"predict {scene} {method}"),
        dask_scheduler(address) as scheduler,
    ):
        predict_scene(
            snakemake.input.left,
            snakemake.input.right,
            snakemake.output.disparity,
            method=method,
            settings=settings,
            **snakemake.params.settings,
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
        )
