"""One strip of a scene's points to the blocks of its disparity grid."""

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.products.grids import Strip
from stereotruth.core.products.making import rule_job
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs

if __name__ == "__main__":
    scene, strip = snakemake.wildcards.scene, Strip.parse(snakemake.wildcards.strip)
    with rule_job(snakemake, f"project {scene} {strip}"):
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
            snakemake.params.store,
            workers=snakemake.threads,
            code=snakemake.params.code,
            scene=scene,
            strip=strip,
        )
        strip.tell(snakemake.output.done)
