"""One synthetic scene's disparities against the exact truth."""

from pathlib import Path

from stereotruth.evaluation.labels_against_truth import MadeScene, evaluate_truth
from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs

if __name__ == "__main__":
    scene = snakemake.wildcards.scene
    made = (snakemake.input[key] for key in ("disparity", "truth", "tiles"))
    with (
        job(snakemake.log[0], f"evaluate {scene}"),
        atomic_outputs(snakemake.input, snakemake.output, snakemake.params),
    ):
        evaluate_truth(
            scene,
            [MadeScene(scene, *map(Path, made))],
            snakemake.output.figures,
            snakemake.output.table,
            workers=snakemake.threads,
            provenance={"code": snakemake.params.code},
        )
