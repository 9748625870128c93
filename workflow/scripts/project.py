"""One scene's points to its disparity grid, or to one strip of its blocks."""

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.job import dask_scheduler
from stereotruth.core.products.grids import Strip
from stereotruth.core.products.making import rule_job
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs

if __name__ == "__main__":
    scene, given, made = snakemake.wildcards.scene, snakemake.input, snakemake.output
    strip = Strip.of_wildcards(snakemake.wildcards)
    with (
        rule_job(snakemake, f"project {scene} {strip or ''}".strip()),
        dask_scheduler(snakemake.resources.dask) as scheduler,
    ):
        inputs = SceneInputs.of(
            given.left,
            given.right,
            given.points,
            LabelSettings(**snakemake.params.settings),
            snakemake.params.view,
            given.alignment,
            given.surface or None,
            given.lidar_strips,
        ).in_light(**snakemake.params.light)
        project_scene(
            inputs,
            snakemake.params.store if strip else made.disparity,
            workers=snakemake.threads,
            scheduler=scheduler,
            code=snakemake.params.code,
            scene=scene,
            strip=strip,
        )
        if strip:
            strip.tell(made.done)
