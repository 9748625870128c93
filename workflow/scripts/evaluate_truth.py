"""One synthetic scene's disparities against the exact truth."""

from stereotruth.evaluation.truth import evaluate_truth
from stereotruth.runlog import job

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    with job(snakemake.log[0], f"evaluate {scene}"):
        evaluate_truth(
            snakemake.input.disparity,
            snakemake.input.truth,
            snakemake.input.tiles,
            snakemake.output.figures,
            snakemake.output.table,
            scene=scene,
            workers=snakemake.threads,
            provenance={"code": snakemake.params.code},
        )
