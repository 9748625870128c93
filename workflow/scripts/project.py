"""One scene's points to its disparity grid."""

from stereotruth.disparity import project_scene
from stereotruth.runlog import job

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    occlusion, settings = snakemake.params.occlusion, snakemake.params.project
    with job(snakemake.log[0], f"project {scene}"):
        project_scene(
            snakemake.input.left,
            snakemake.input.right,
            snakemake.input.points,
            snakemake.output.disparity,
            view=snakemake.params.view,
            method=occlusion["method"],
            window=occlusion["window"],
            correlation_threshold=occlusion["correlation_threshold"],
            representative=settings["representative"],
            edge_margin_px=settings["edge_margin_px"],
            min_points=settings["min_points_per_px"],
            workers=snakemake.threads,
            code=snakemake.params.code,
            scene=scene,
        )
