"""One strip of a scene's points to the blocks of its disparity grid."""

from stereotruth.disparity.project import project_scene
from stereotruth.disparity.settings import Settings
from stereotruth.job import job
from stereotruth.products.grids import Strip
from stereotruth.products.publication import publication

if __name__ == "__main__":
    scene, strip = snakemake.wildcards.scene, Strip.parse(snakemake.wildcards.strip)
    with (
        job(snakemake.log[0], f"project {scene} {strip}"),
        publication(snakemake.input, snakemake.output, snakemake.params),
    ):
        project_scene(
            snakemake.input.left,
            snakemake.input.right,
            snakemake.input.points,
            snakemake.params.store,
            Settings(**snakemake.params.settings),
            alignment=snakemake.input.alignment,
            view=snakemake.params.view,
            workers=snakemake.threads,
            code=snakemake.params.code,
            scene=scene,
            strip=strip,
        )
        strip.tell(snakemake.output.done)
