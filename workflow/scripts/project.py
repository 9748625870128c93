"""One scene's points to its disparity grid."""

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.job import dask_scheduler
from stereotruth.core.products.making import rule_job
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs

if __name__ == "__main__":
    scene, address = snakemake.wildcards.scene, snakemake.resources.dask
    with rule_job(snakemake, f"project {scene}"), dask_scheduler(address) as scheduler:
        inputs = SceneInputs.of(
            snakemake.input.left,
            snakemake.input.right,
            snakemake.input.points,
            LabelSettings(**snakemake.params.settings),
            snakemake.params.view,
            snakemake.input.alignment,
            snakemake.input.surface or None,
            snakemake.input.lidar_strips,
        ).in_light(**snakemake.params.light)
        project_scene(
            inputs,
            snakemake.output.disparity,
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
        )
